"""A soft arm bent by tendons, with the positions of their motors as inputs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor

from pinn_dyn.systems.soft_arm import SoftArm

PerSegment = Annotated[Sequence[NonNegativeFloat], Field(min_length=3)]
"""A number for each coordinate of a segment, the same for all segments, or for all segments."""


class TendonArm(SoftArm):
    """Soft arm whose inputs are angles of motors that wind up elastic tendons::

        s(q, u) = B q + spool u + pretension / k,     T(s) = k (s + sqrt(s^2 + slack^2)) / 2
        f(q, u) = -B^T T(s),     F_i(v) = friction_i tanh(v_i / friction_speed_i)

    Tendon j of segment i runs parallel to the backbone, at the distance ``radius`` and the angle
    phi_j = 2 pi j / tendons, from the base to the tip of the segment. Its length changes by B q::

        (B q)_ij = sum over k <= i of dl_k - radius (cos(phi_j) dx_k + sin(phi_j) dy_k)

    s is the stretch in m, and T the tension in N: k s if taut, and 0 if slack. Tendons cannot push,
    so f is not linear in u (``input_affine`` is false). The tendons at u = 0 belong to the
    potential, and A(q) u becomes f(q, u) - f(q, 0). F is dry friction.

    Symbols: q as for :class:`SoftArm`, ``(*batch, 3 n)``; u motor angles, ``(*batch, M)``, rad;
    positive angles pull.

    Args:
        segments: n, number of segments.
        tendons: tendons per segment; M = n tendons.
        radius: distance of the tendons from the backbone, m.
        spool: radius of the spools of the motors, m.
        tendon_stiffness: k, N/m.
        pretension: tension at q = 0 and u = 0, N.
        slack: stretch over which a tendon goes from slack to taut, m.
        friction: largest dry friction of a segment, ``(3,)`` or ``(3 n,)``, Nm and N.
        friction_speed: speed at 76 % of that friction, ``(3,)`` or ``(3 n,)``, rad/s
            and m/s.
        mass, length, gravity: see :class:`SoftArm`.
        stiffness, damping: of the backbone of a segment, ``(3,)`` or ``(3 n,)``, see
            :class:`SoftArm`.
    """

    input_affine = False

    def __init__(
        self,
        segments: PositiveInt = 1,
        *,
        tendons: Annotated[int, Field(ge=3)] = 3,
        radius: PositiveFloat = 0.04,
        spool: PositiveFloat = 0.02,
        tendon_stiffness: PositiveFloat = 1000.0,
        pretension: NonNegativeFloat = 10.0,
        slack: PositiveFloat = 5e-4,
        friction: PerSegment = (0.03, 0.03, 0.2),
        friction_speed: PerSegment = (0.2, 0.2, 0.02),
        mass: NonNegativeFloat | Sequence[NonNegativeFloat] = 0.3,
        length: PositiveFloat = 0.2,
        gravity: NonNegativeFloat = 9.81,
        stiffness: PerSegment = (0.5, 0.5, 600.0),
        damping: PerSegment = (0.05, 0.05, 30.0),
    ):
        size = 3 * segments
        elastic, viscous, level, speed = (
            list(x) * (size // len(x)) for x in (stiffness, damping, friction, friction_speed)
        )
        bodies: dict[str, Any] = {"mass": mass, "length": length, "gravity": gravity}
        super().__init__(segments, stiffness=elastic, damping=viscous, **bodies)
        self.num_inputs = segments * tendons
        self.tendons, self.radius, self.spool = tendons, radius, spool
        self.pretension, self.slack = pretension, slack
        self.constants |= {
            "tendon_stiffness": ["N/m"],
            "friction": ["Nm", "Nm", "N"] * segments,
            "friction_speed": ["rad/s", "rad/s", "m/s"] * segments,
        }
        buffers = {"friction": level, "friction_speed": speed, "tendon_stiffness": tendon_stiffness}
        for name, value in buffers.items():
            self.register_buffer(name, torch.tensor(value, dtype=torch.float64))
        angles = 2 * math.pi / tendons * torch.arange(tendons, dtype=torch.float64)
        lengths = [-radius * angles.cos(), -radius * angles.sin(), torch.ones_like(angles)]
        upstream = torch.ones(segments, segments, dtype=torch.float64).tril()
        self.register_buffer("routing", torch.kron(upstream, torch.stack(lengths, -1)))

    def potential_energy(self, q: Tensor) -> Tensor:
        """Return V(q) of the arm and of the tendons at u = 0, ``(*batch,)``."""
        s, w = self._stretch(q, 0.0), self.slack
        root = (s * s + w * w).sqrt()
        energy = self.tendon_stiffness.to(q) / 4 * (s * s + s * root + w * w * (s / w).asinh())
        return super().potential_energy(q) + energy.sum(-1)

    def input_matrix(self, q: Tensor) -> Tensor:
        """Return A(q) = df/du at u = 0, ``(*batch, 3 n, M)``."""
        s = self._stretch(q, 0.0)
        slope = 0.5 * self.tendon_stiffness.to(q) * (1 + s / (s * s + self.slack**2).sqrt())
        return -self.spool * self.routing.to(q).mT * slope.unsqueeze(-2)

    def typical_input(self, q: Tensor) -> Tensor:
        """Return the angles that keep the pretension, ``(*batch, M)``; 0 for redundant tendons."""
        angles = -q @ self.routing.to(q).mT / self.spool
        return angles if self.num_inputs == self.num_coordinates else 0 * angles

    def tensions(self, q: Tensor, u: Tensor | float) -> Tensor:
        """Return the tensions T, ``(*batch, M)``, N."""
        s = self._stretch(q, u)
        return 0.5 * self.tendon_stiffness.to(s) * (s + (s * s + self.slack**2).sqrt())

    def _stretch(self, q: Tensor, u: Tensor | float) -> Tensor:
        start = self.pretension / self.tendon_stiffness.to(q)
        return q @ self.routing.to(q).mT + self.spool * u + start

    def input_force(self, q: Tensor, u: Tensor) -> Tensor:
        return (self.tensions(q, 0.0) - self.tensions(q, u)) @ self.routing.to(q)

    def _potential_force_of(self, q: Tensor, jacobian: Tensor) -> Tensor:
        return super()._potential_force_of(q, jacobian) + self.tensions(q, 0.0) @ self.routing.to(q)

    def friction_force(self, v: Tensor) -> Tensor:
        return self.friction.to(v) * (v / self.friction_speed.to(v)).tanh()

    def friction_slope(self, v: Tensor) -> Tensor:
        speed = self.friction_speed.to(v)
        return self.friction.to(v) / speed * (1 - (v / speed).tanh().square())
