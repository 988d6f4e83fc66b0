"""Position servos, which take a target position instead of a force as input."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Literal

import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat
from torch import Tensor, nn

from pinn_dyn import wording
from pinn_dyn.mechanics.arrays import listed
from pinn_dyn.models.drives import Drives
from pinn_dyn.models.known_constants import Constants
from pinn_dyn.models.scales import Scales

_START = 10.0  # initial k in units of the typical force over the spread of q
_SHARPNESS = 8  # the force is 0.92 of its limit where the linear law reaches the limit
_BEYOND = 1e3  # ratio to the limit beyond which the force is constant


class Servo(Drives):
    """Position servos with targets u, and optional feed-forward forces f::

        s = k (u - q) - d v + f,      tau = s / (1 + |s / L|^8)^(1/8)

    Without a limit L, tau = s. The spring is a part of the potential, V + k q^2 / 2, and d is a
    part of the damping matrix. A model with a servo is therefore passive at a constant target. The
    input matrix is A = k, or (k, 1) with feed-forward forces, and A^-1 gives the target for a force
    exactly. Without a limit, d is zero, because the damping of the joint includes it.

    k ``(n,)`` is in Nm/rad or N/m, d in Nms/rad or Ns/m, L in Nm or N. If k is learned, the motion
    determines all forces only up to a common factor. A fixed k, known bodies or a feed-forward
    force determine the factor.

    Args:
        scales: scales of the data. With a prior, the value is the typical force, ``(N,)``.
        stiffness: initial k, one number or n. The default is computed from the data, and from the
            limit if it is a number.
        spread: prior standard deviation of the logarithm of the constants; 0 fixes k.
        limit: L, one number or n; ``"learned"``; or None for a servo that does not saturate.
        joints: coordinates with a servo, in the order of the targets. The default is all.

    Raises:
        ValueError: if the data do not have n or 2 n inputs.
    """

    takes_targets = True
    stiffness: Constants | None
    damping: Constants | None
    limit: Constants | None
    error: Tensor
    fixed_stiffness: Tensor
    fixed_limit: Tensor

    def __init__(
        self,
        scales: Scales,
        *,
        stiffness: PositiveFloat | Sequence[PositiveFloat] | None = None,
        spread: NonNegativeFloat = 1.5,
        limit: PositiveFloat | Sequence[PositiveFloat] | Literal["learned"] | None = None,
        joints: Sequence[NonNegativeInt] | None = None,
    ):
        super().__init__(scales, joints)
        index, inputs = self.joints, self.shape[1]
        if inputs not in (len(index), 2 * len(index)):
            raise ValueError(
                f"the data have {inputs} inputs, expected targets of {len(index)} joints, or "
                "targets followed by feed-forward forces: correct "
                f"{wording.setting('dataset.u.columns')}, or "
                f"{wording.setting('model.input.joints')}"
            )
        data = scales.statistics
        force = scales.value.double()
        if not scales.prior:
            force = super().typical_force(data.u_rms[-len(index) :]).double()
        spread_of_q = data.q_std[index].double()
        stiffness, limit = listed(stiffness), listed(limit)
        if stiffness is None and limit not in (None, "learned"):
            # The servo saturates at an error of a standard deviation of q.
            stiffness = (torch.as_tensor(limit) / spread_of_q).tolist()
        if stiffness is None:
            start = _START * force[index] / spread_of_q
        else:
            start = torch.as_tensor(stiffness, dtype=torch.float64).expand(len(index)).clone()
            force = force.index_copy(0, torch.tensor(index), start * spread_of_q / _START)
        self._force, force = force, force[index]
        build = partial(scales.restricted(index).positive, spread=spread or 1.5)
        self.stiffness = None
        if spread > 0:
            self.stiffness = build("servo stiffness", 1.0, start, quantity="stiffness")
        self.damping = self.limit = None
        self.affine = self.identified_by_forces = limit is None
        if not self.affine:
            rate = force / data.v_std[index]
            self.damping = build("servo damping", 0.1, rate, quantity="damping")
        if limit == "learned":
            self.limit, limit = build("servo limit", 1.0, force, quantity="force"), None
        unlimited = torch.finfo(torch.float32).max  # a checkpoint has no infinite numbers
        largest = torch.as_tensor(limit or unlimited, dtype=torch.float32)
        self.register_buffer("error", (spread_of_q / _START).float(), persistent=False)
        self.register_buffer("fixed_limit", largest.expand(len(index)).clone())
        self.register_buffer("fixed_stiffness", start.float())
        self.register_buffer("initial_strength", self.strength().detach().clone())

    def spring_constant(self) -> Tensor:
        """Return k, ``(n,)``."""
        return self.fixed_stiffness if self.stiffness is None else self.stiffness()

    def strength(self) -> Tensor:
        """Return 1 / (1/k + e/L), ``(n,)``, the force per error of a typical target error e."""
        stiffness = self.spring_constant()
        return stiffness / (1 + stiffness * self.error / self.largest_force())

    def springs(self) -> Tensor:
        """Return k of all coordinates, ``(N,)``; 0 for a coordinate without a servo."""
        return self.spring_constant() @ self.selection

    def damping_rates(self) -> Tensor:
        """Return d of all coordinates, ``(N,)``; 0 for a coordinate without a servo."""
        rate = torch.zeros_like(self.spring_constant()) if self.damping is None else self.damping()
        return rate @ self.selection

    def forward(self, q: Tensor) -> Tensor:
        """Return A, ``(*batch, N, M)``."""
        columns = self.spring_constant()[:, None] * self.selection
        if self.shape[1] > len(columns):
            columns = torch.cat([columns, self.selection])
        return columns.mT.expand(*q.shape[:-1], -1, -1)

    def typical_input(self, q: Tensor) -> Tensor:
        """Return the targets without force at rest, ``(*batch, M)``."""
        targets = q @ self.selection.mT
        return nn.functional.pad(targets, (0, self.shape[1] - targets.shape[-1]))

    def motor_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return self._limited(self._linear_torque(q, v, u)) @ self.selection

    def applied(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        force = self.force(q, u)
        if self.affine:
            return force
        linear = self._linear_torque(q, v, u)
        return force + (self._limited(linear) - linear) @ self.selection

    def typical_force(self, u_rms: Tensor) -> Tensor:
        """Return the force of a typical lag, ``(N,)``: k times a tenth of the spread of q."""
        return self._force.to(u_rms)

    def _linear_torque(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return s, ``(*batch, n)``."""
        target, *feedforward = u.split(len(self.selection), dim=-1)
        side = self.selection.mT
        torque = sum(feedforward, self.spring_constant() * (target - q @ side))
        return torque if self.damping is None else torque - self.damping() * (v @ side)

    def largest_force(self) -> Tensor:
        """Return L, ``(n,)``."""
        return self.fixed_limit if self.limit is None else self.limit()

    def _limited(self, linear: Tensor) -> Tensor:
        if self.affine:
            return linear
        limit = self.largest_force()
        ratio = (linear / limit).clamp(-_BEYOND, _BEYOND)
        return limit * ratio / (1 + ratio**_SHARPNESS) ** (1 / _SHARPNESS)
