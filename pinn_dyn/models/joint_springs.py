"""Springs between joints and their parents, such as springs that carry the weight of an arm."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pinn_dyn.models.known_constants import Named, RealConstants
from pinn_dyn.models.scales import Scales

_START = 0.3  # initial k in units of the typical force over the spread of q
_SPREAD = 2.0  # prior standard deviation of log k
_PRELOAD = 3.0  # prior standard deviation of p in typical forces: springs may carry the weight


class JointSprings(nn.Module):
    """Linear springs at S of N joints, with the potential V and the force dV/dq::

        V = sum over j of k_j (q_j - r_j)^2 / 2,    dV/dq_j = k_j q_j - p_j,    p_j = k_j r_j

    k ``(S,)`` in Nm/rad or N/m is positive. The rest angle or position r follows from the force p
    at q = 0 in Nm or N, in which the equation of motion is linear.

    Args:
        scales: scales of the data. The value is a typical generalized force, ``(N,)``.
        joints: coordinates with a spring.
    """

    selection: Tensor

    def __init__(self, scales: Scales, joints: Sequence[int]):
        super().__init__()
        index, force = list(joints), scales.value.double()
        named = [scales.joints[k] for k in index]
        units = [joint.force + ("/rad" if joint.turns else "/m") for joint in named]
        start = force / scales.statistics.q_std.double()
        part = Scales(scales.statistics, start, named=tuple(named), prior=True)
        self.stiffness = part.positive("spring stiffness", _START, start[index], _SPREAD, units)
        self.preload = RealConstants(
            _PRELOAD * force[index],
            [f"rest {'angle' if joint.turns else 'position'} of {joint.name}" for joint in named],
            [joint.force for joint in named],
        )
        self.register_buffer("selection", torch.eye(scales.size)[index], persistent=False)

    def springs(self) -> Tensor:
        """Return k of all coordinates, ``(N,)``; 0 for a joint without a spring."""
        return self.stiffness() @ self.selection

    def constant_force(self) -> Tensor:
        """Return p of all coordinates, ``(N,)``."""
        return self.preload() @ self.selection

    def rest_positions(self) -> Tensor:
        """Return r of all coordinates, ``(N,)``; 0 for a joint without a spring."""
        return (self.preload() / self.stiffness()) @ self.selection

    def physical_constants(self) -> list[Named]:
        """Return k and r."""
        rest = self.preload() / self.stiffness()
        units = ["rad" if unit == "Nm" else "m" for unit in self.preload.units]
        return [self.stiffness.named(), self.preload.named()._replace(values=rest, units=units)]
