"""Springs between joints and their parents, and elastic joints with motors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from pydantic import PositiveFloat
from torch import Tensor, nn
from torch.nn.functional import pad

from pinn_dyn.models.known_constants import (
    Constants,
    HasConstants,
    Named,
    PositiveConstants,
    RealConstants,
)
from pinn_dyn.models.scales import Joint, Scales
from pinn_dyn.models.structure import Structure

_START = 0.3  # initial k in units of the typical force over the spread of q
_SPREAD = 2.0  # prior standard deviation of the logarithms
_PRELOAD = 3.0  # prior standard deviation of p in typical forces, as springs may carry the weight


class Springs(HasConstants):
    """Linear springs with the stretches s = B q ``(S,)``, and the force B^T f on the coordinates::

        f = K s + D ds/dt - p

    K is in Nm/rad or N/m, D in Nms/rad or Ns/m and p in Nm or N, ``(S,)`` each.

    Args:
        stretch: B, ``(S, N)``.
        stiffness, damping, preload: learned K, D and p; None for zero.
    """

    stretch: Tensor

    def __init__(
        self,
        stretch: Tensor,
        stiffness: Constants,
        *,
        damping: Constants | None = None,
        preload: Constants | None = None,
    ):
        super().__init__()
        self.register_buffer("stretch", stretch.clone(), persistent=False)
        self.stiffness, self.damping, self.preload = stiffness, damping, preload

    def forces(self, q: Tensor, v: Tensor) -> Tensor:
        """Return f, ``(*batch, S)``."""
        force = self.stiffness() * (q @ self.stretch.mT)
        if self.damping is not None:
            force = force + self.damping() * (v @ self.stretch.mT)
        return force if self.preload is None else force - self.preload()

    def matrices(self) -> tuple[Tensor, Tensor]:
        """Return stiffness and damping of the coordinates, ``(N, N)``."""
        side = self.stretch.mT
        stiffness = (side * self.stiffness()) @ side.mT
        if self.damping is None:
            return stiffness, torch.zeros_like(stiffness)
        return stiffness, (side * self.damping()) @ side.mT


class JointSprings(Springs):
    """Linear springs at S of N joints, with the potential V and the force dV/dq::

        V = sum over j of k_j (q_j - r_j)^2 / 2,    dV/dq_j = k_j q_j - p_j,    p_j = k_j r_j

    k ``(S,)``, Nm/rad or N/m, is positive. The force p at q = 0, Nm or N, is learned instead of the
    rest angle or position r, because the equation of motion is linear in p.

    Args:
        scales: scales of the data. The value is a typical generalized force, ``(N,)``.
        index: coordinates with a spring.
    """

    preload: RealConstants

    def __init__(self, scales: Scales, index: Sequence[int]):
        part, force = scales.restricted(index), scales.value.double()[list(index)]
        start = force / scales.statistics.q_std.double()[list(index)]
        kinds = {True: "rest angle", False: "rest position"}
        names = [f"{kinds[joint.turns]} of {joint.name}" for joint in part.joints]
        forces = [joint.unit("force") for joint in part.joints]
        super().__init__(
            torch.eye(scales.size)[list(index)],
            part.positive("spring stiffness", _START, start, _SPREAD, "stiffness"),
            preload=RealConstants(_PRELOAD * force, names, forces),
        )
        self._units = [joint.unit("position") for joint in part.joints]

    def constant_force(self) -> Tensor:
        """Return p of all coordinates, ``(N,)``."""
        return self.preload() @ self.stretch

    def rest_positions(self) -> Tensor:
        """Return r, ``(S,)``."""
        return self.preload() / self.stiffness()

    def physical_constants(self) -> list[Named]:
        """Return k and r."""
        rest = self.preload.named()._replace(values=self.rest_positions(), units=self._units)
        return [self.stiffness.named(), rest]


_RATE = 1e-3  # ratio of initial damping to stiffness, s


class ElasticJoints(nn.Module):
    """Structure with N link angles q and S motor angles theta of elastic joints::

        M(q) a + C v + G + F(v) = K (theta - q) + D (theta_dot - v)
        B theta_ddot + F_m(theta_dot) + K (theta - q) + D (theta_dot - v) = tau

    The coordinates are (q, theta), both after the gear and measured. B is the armature and F_m the
    friction of a motor. K and D of each elastic joint are learned. Source:
    Spong (1987), "Modeling and control of elastic joint robots".

    Args:
        chain: the rigid bodies, such as a :class:`~pinn_dyn.systems.RigidChain`.
        joints: names of the elastic joints, in the order of theta. The default is all.
        stiffness: initial K, Nm/rad or N/m.

    Raises:
        ValueError: if the chain does not have one of the joints.
    """

    def __init__(
        self,
        chain: Structure,
        *,
        joints: Sequence[str] | None = None,
        stiffness: PositiveFloat = 1000.0,
    ):
        super().__init__()
        self.chain, self.joints, self.stiffness = chain, joints, stiffness
        names, self.size = chain.joint_names, chain.num_coordinates
        elastic = list(joints or names)
        if unknown := set(elastic) - set(names):
            raise ValueError(f"joints names {', '.join(unknown)}, expected some of {names}")
        links = [names.index(name) for name in elastic]
        self.num_coordinates = self.size + len(elastic)
        self.joint_names = [*names, *(f"{name}_motor" for name in elastic)]
        self.turning = [*chain.turning, *(chain.turning[k] for k in links)]
        self.body_names, self.body_joints = chain.body_names, chain.body_joints
        self.generic_inertia, self.prior_inertia = chain.generic_inertia, chain.prior_inertia
        self.parameters_of = chain.parameters_of
        self.driven = [f"{name}_motor" if name in elastic else name for name in names]
        unit = torch.eye(self.num_coordinates)
        self.stretch = unit[self.size :] - unit[links]

    @property
    def inertia(self) -> Tensor:
        """Pseudo-inertias of the bodies, ``(n, 4, 4)``."""
        return self.chain.inertia

    def motor_forces(self, force: Tensor) -> Tensor:
        """Return the forces of the links at their motors, ``(N + S,)``.

        ``force`` ``(N + S,)`` acts on (q, theta).
        """
        return self.stretch.clamp(min=0).to(force).mT @ (self.stretch.abs().to(force) @ force)

    def mass_matrix(self, q: Tensor, inertia: Tensor) -> Tensor:
        return self._matrix(self.chain.mass_matrix(self._links(q), inertia))

    def potential_energy(self, q: Tensor, inertia: Tensor) -> Tensor:
        return self.chain.potential_energy(self._links(q), inertia)

    def mass_and_bias(self, q: Tensor, v: Tensor, inertia: Tensor) -> tuple[Tensor, Tensor]:
        mass, bias = self.chain.mass_and_bias(self._links(q), self._links(v), inertia)
        return self._matrix(mass), self._vector(bias)

    def rigid_force(
        self, q: Tensor, v: Tensor, a: Tensor, inertia: Tensor, gravity: bool
    ) -> Tensor:
        q, v, a = map(self._links, (q, v, a))
        return self._vector(self.chain.rigid_force(q, v, a, inertia, gravity=gravity))

    def regressor(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        return self._vector(self.chain.regressor(*map(self._links, (q, v, a))).mT).mT

    def force_slopes(
        self, q: Tensor, v: Tensor, a: Tensor, inertia: Tensor
    ) -> tuple[Tensor, Tensor]:
        q, v, a = map(self._links, (q, v, a))
        by_q, by_v = self.chain.force_slopes(q, v, a, inertia)
        return self._matrix(by_q), self._matrix(by_v)

    def _links(self, x: Tensor) -> Tensor:
        return x[..., : self.size]

    def _vector(self, x: Tensor) -> Tensor:
        return pad(x, (0, self.num_coordinates - self.size))

    def _matrix(self, x: Tensor) -> Tensor:
        return self._vector(self._vector(x).mT).mT

    def springs(self) -> Springs:
        """Build the springs between links and motors, with learned K and D."""
        names, turning = self.joint_names[self.size :], self.turning[self.size :]
        joints = [
            Joint(name.removesuffix("_motor"), turns)
            for name, turns in zip(names, turning, strict=True)
        ]
        start = torch.full((len(joints),), float(self.stiffness)).double()

        def constants(quantity: str, start: Tensor) -> Constants:
            labels = [f"joint {quantity} of {joint.name}" for joint in joints]
            units = [joint.unit(quantity) for joint in joints]
            return PositiveConstants(start, _SPREAD, labels, units)

        damping = constants("damping", _RATE * start)
        return Springs(self.stretch, constants("stiffness", start), damping=damping)
