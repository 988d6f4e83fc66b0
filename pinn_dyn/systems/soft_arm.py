"""A soft arm of n constant-curvature segments, the plant of the paper's first two tasks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor

from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import matvec, spd_solve
from pinn_dyn.systems.segment_frames import (
    Tip,
    first_slopes,
    in_world,
    second_slopes,
    stumpff,
    tip_rotation,
    turning_bias,
)


class SoftArm(MechanicalSystem):
    """Piecewise-constant-curvature arm with mass spread along its backbone.

    Each segment has q_i = (dx, dy, dl): bending of the tip frame along x and y in rad and
    elongation in m. With theta^2 = dx^2 + dy^2 and L = length + dl, the backbone point at
    s in [0, 1] in the frame of the segment's base is::

        r(s) = L [dx (1 - cos(s theta))/theta^2, dy (1 - cos(s theta))/theta^2, sin(s theta)/theta]

    and the tip frame is turned by theta about the axis (-dy, dx, 0). Then::

        M = sum_i mass_i int J^T J ds          (point masses, no rotational inertia)
        V = stiffness^T q^2 / 2 - sum_i mass_i gravity int z ds        (the arm hangs along +z)
        D = diag(damping)
        A = [A_1 ... A_n],  A_i = transposed Jacobian of (-omega_x, -omega_y, v_z) of tip i, in
                            its own frame: two bending torques in Nm and an axial force in N

    The integrals are Gauss-Legendre sums. Stumpff functions replace all divisions by theta. A
    segment bends by up to theta = 2 pi.

    Source: paper, section Simulation Results, in the parametrization of Della Santina, Bicchi and
    Rus 2020 (IEEE RA-L 5(2)); the constants reproduce the paper's tables.

    Mass ``(n,)``, stiffness ``(N,)`` and damping ``(N,)`` are buffers, which a model may learn
    (:class:`~pinn_dyn.models.KnownSystem`).

    Args:
        segments: n, number of segments; N = M = 3 n.
        mass: mass of each segment, kg; one number or n. A segment without mass leaves M singular.
        length: rest length of each segment, m.
        gravity: gravitational acceleration along +z, m/s^2.
        stiffness: elastic stiffness, Nm/rad for bending, N/m for elongation; one number or N.
        damping: viscous damping, Nms/rad and Ns/m; one number or N.
        nodes: Gauss-Legendre nodes per segment; 10 are exact to 1e-12 for theta <= 3.
    """

    z_is_down = True

    def __init__(
        self,
        segments: PositiveInt = 1,
        *,
        mass: NonNegativeFloat | Sequence[NonNegativeFloat] = 0.3,
        length: PositiveFloat = 0.2,
        gravity: NonNegativeFloat = 9.81,
        stiffness: NonNegativeFloat | Sequence[NonNegativeFloat] = 1.0,
        damping: NonNegativeFloat | Sequence[NonNegativeFloat] = 0.1,
        nodes: PositiveInt = 10,
    ):
        super().__init__(num_coordinates=3 * segments, num_inputs=3 * segments)
        self.segments = segments
        self.length = length
        self.gravity = gravity
        self.constants = {
            "mass": ["kg"] * segments,
            "stiffness": ["Nm/rad", "Nm/rad", "N/m"] * segments,
            "damping": ["Nms/rad", "Nms/rad", "Ns/m"] * segments,
        }
        for name, values in (("mass", mass), ("stiffness", stiffness), ("damping", damping)):
            constants = torch.as_tensor(values, dtype=torch.float64)
            self.register_buffer(name, constants.expand(len(self.constants[name])).clone())
        points, weights = np.polynomial.legendre.leggauss(nodes)
        # Not persistent: a checkpoint in single precision would round them.
        for name, value in (("_s", (points + 1) / 2), ("_weights", weights / 2)):
            self.register_buffer(name, torch.from_numpy(value), persistent=False)

    @property
    def nodes(self) -> int:
        """Number of Gauss-Legendre nodes per segment."""
        return len(self._s)

    def check_domain(self, q_low: np.ndarray, q_high: np.ndarray) -> None:
        """Check that the equation of motion holds for all q from ``q_low`` to ``q_high``, ``(N,)``.

        Raises:
            ValueError: if a segment has no positive length, or bends by a full turn, in this range.
        """
        low, high = (np.asarray(q, dtype=float).reshape(-1, 3) for q in (q_low, q_high))
        bends = np.hypot(*np.maximum(np.abs(low), np.abs(high))[:, :2].T)
        for k, (shortest, bend) in enumerate(zip(self.length + low[:, 2], bends, strict=True)):
            if not (shortest > 0 and bend < 2 * np.pi):
                raise ValueError(
                    f"segment {k + 1} shortens to {shortest:.3g} m and bends by up to {bend:.3g} "
                    "rad, expected a positive length and less than 2 pi"
                )

    def mass_matrix(self, q: Tensor) -> Tensor:
        """Return M(q) = sum_i mass_i int J^T J ds, ``(*batch, N, N)``."""
        jacobian, _, _ = self._chain(q)
        return self._gram(jacobian)

    def potential_energy(self, q: Tensor) -> Tensor:
        """Return V(q) = stiffness^T q^2 / 2 - sum_i mass_i gravity int z ds, ``(*batch,)``."""
        depths = self.backbone(q, self._s)[..., 2] @ self._weights.to(q)
        elastic = 0.5 * (self.stiffness.to(q) * q * q).sum(-1)
        return elastic - self.gravity * (depths @ self.mass.to(q))

    def damping_matrix(self, q: Tensor) -> Tensor:
        """Return D = diag(damping), ``(*batch, N, N)``."""
        return torch.diag_embed(self.damping.to(q).expand_as(q))

    def input_matrix(self, q: Tensor) -> Tensor:
        """Return A(q) = [A_1 ... A_n], ``(*batch, N, 3 n)``."""
        _, _, tips = self._chain(q, nodes=self._s[:0])
        columns = []
        for tip in tips:
            angular, linear = tip.rotation.mT @ tip.angular, tip.rotation.mT @ tip.linear
            columns += [-angular[..., 0, :], -angular[..., 1, :], linear[..., 2, :]]
        return torch.stack(columns, dim=-1)

    def tip_position(self, q: Tensor) -> Tensor:
        """Return the position of the tip in the world frame, ``(*batch, 3)``, m."""
        return self.backbone(q, q.new_ones(1))[..., -1, 0, :]

    def lines(self, q: Tensor) -> Tensor:
        """Return the backbone as lines of 21 points, ``(*batch, n, 21, 3)``, m."""
        return self.backbone(q, torch.linspace(0, 1, 21, dtype=q.dtype, device=q.device))

    def backbone(self, q: Tensor, s: Tensor) -> Tensor:
        """Return points at the fractions s ``(S,)`` of each segment, ``(*batch, n, S, 3)``, m."""
        position = q.new_zeros((*q.shape[:-1], 3))
        rotation = torch.eye(3, dtype=q.dtype, device=q.device).expand(*q.shape[:-1], 3, 3)
        segments = []
        for block in q.split(3, dim=-1):
            local = self._local_points(block, s.to(q))
            segments.append(position.unsqueeze(-2) + local @ rotation.mT)
            tip = self._local_points(block, q.new_ones(1)).squeeze(-2)
            position = position + matvec(rotation, tip)
            turn, _ = tip_rotation(block, stumpff((block[..., :2] ** 2).sum(-1, keepdim=True)))
            rotation = rotation @ turn
        return torch.stack(segments, dim=-3)

    # For point masses, C(q, v) v = sum m J^T (dJ/dt) v needs no derivative of M.

    def _potential_force(self, q: Tensor) -> Tensor:
        jacobian, _, _ = self._chain(q)
        return self._potential_force_of(q, jacobian)

    def inertial_force(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        jacobian, bias, _ = self._chain(q, v)
        return matvec(self._gram(jacobian), a) + self._coriolis_force_of(jacobian, bias)

    def _acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        jacobian, bias, _ = self._chain(q, v)
        force = force - (
            self._coriolis_force_of(jacobian, bias) + self._potential_force_of(q, jacobian)
        )
        return spd_solve(self._gram(jacobian), force)

    def _point_masses(self, like: Tensor) -> Tensor:
        return torch.outer(self.mass.to(like), self._weights.to(like)).flatten()

    def _gram(self, jacobian: Tensor) -> Tensor:
        weighted = jacobian * self._point_masses(jacobian)[:, None, None]
        return jacobian.flatten(-3, -2).mT @ weighted.flatten(-3, -2)

    def _coriolis_force_of(self, jacobian: Tensor, bias: Tensor) -> Tensor:
        force = bias * self._point_masses(bias)[:, None]
        return matvec(jacobian.flatten(-3, -2).mT, force.flatten(-2))

    def _potential_force_of(self, q: Tensor, jacobian: Tensor) -> Tensor:
        lift = (jacobian[..., 2, :] * self._point_masses(q)[:, None]).sum(-2)
        return self.stiffness.to(q) * q - self.gravity * lift

    def _chain(
        self, q: Tensor, v: Tensor | None = None, nodes: Tensor | None = None
    ) -> tuple[Tensor, Tensor, list[Tip]]:
        """Return dr/dq ``(*batch, S, 3, N)`` at S points, (d/dt dr/dq) v, and the tip frames."""
        s = (self._s if nodes is None else nodes).to(q)
        ends = torch.cat([s, s.new_ones(1)])
        base: Tip | None = None
        jacobians, biases, tips = [], [], []
        for index in range(self.segments):
            block = slice(3 * index, 3 * index + 3)
            local_v = None if v is None else v[..., block]
            r, jac, bias, turn, spin, spin_bias = self._segment(q[..., block], local_v, ends)
            widths = 3 * index, self.num_coordinates - 3 * index - 3
            jac, spin = (torch.nn.functional.pad(x, widths) for x in (jac, spin))
            if base is not None:
                r, jac, bias, turn, spin, spin_bias = in_world(
                    base, v, r, jac, bias, turn, spin, spin_bias
                )
            jacobians.append(jac[..., :-1, :, :])
            biases.append(bias[..., :-1, :])
            base = Tip(r[..., -1, :], turn, jac[..., -1, :, :], spin, bias[..., -1, :], spin_bias)
            tips.append(base)
        return torch.cat(jacobians, -3), torch.cat(biases, -2), tips

    def _segment(
        self, q: Tensor, v: Tensor | None, s: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the kinematics of one segment in its base frame.

        These are, at the points ``s`` (the last point is the tip), r ``(*batch, S, 3)``, its
        Jacobian ``(*batch, S, 3, 3)`` and bias (dJ/dt) v ``(*batch, S, 3)``; and, at the tip, the
        rotation ``(*batch, 3, 3)``, the Jacobian of the angular velocity ``(*batch, 3, 3)`` and its
        bias ``(*batch, 3)``.
        """
        dx, dy, dl = (x.unsqueeze(-1) for x in q.unbind(-1))
        length = self.length + dl
        square = dx * dx + dy * dy
        c = stumpff(square * s * s)
        c1x, c2x, c3x = first_slopes(c)
        # r = L [dx F, dy F, E] with functions F (bend) and E (reach) of theta^2, and their slopes.
        s2 = s * s
        bend, reach = s2 * c[2], s * c[1]
        bend_x, reach_x = s2 * s2 * c2x, s2 * s * c1x
        r = torch.stack([length * dx * bend, length * dy * bend, length * reach], dim=-1)
        cross = 2 * length * dx * dy * bend_x
        twice = 2 * length * reach_x
        jacobian = torch.stack(
            [
                torch.stack([length * (bend + 2 * dx * dx * bend_x), cross, dx * bend], -1),
                torch.stack([cross, length * (bend + 2 * dy * dy * bend_x), dy * bend], -1),
                torch.stack([twice * dx, twice * dy, reach], -1),
            ],
            dim=-2,
        )
        turn, spin = tip_rotation(q, c)
        if v is None:
            return r, jacobian, torch.zeros_like(r), turn, spin, torch.zeros_like(q)

        vx, vy, vl = (x.unsqueeze(-1) for x in v.unbind(-1))
        c1xx, c2xx = second_slopes(c)
        rate = 2 * (dx * vx + dy * vy)
        second = 2 * (vx * vx + vy * vy)
        bend_1 = bend_x * rate
        bend_2 = s2 * s2 * s2 * c2xx * rate * rate + bend_x * second
        reach_1 = reach_x * rate
        reach_2 = s2 * s2 * s * c1xx * rate * rate + reach_x * second
        bias = torch.stack(
            [
                2 * vl * (vx * bend + dx * bend_1) + length * (2 * vx * bend_1 + dx * bend_2),
                2 * vl * (vy * bend + dy * bend_1) + length * (2 * vy * bend_1 + dy * bend_2),
                2 * vl * reach_1 + length * reach_2,
            ],
            dim=-1,
        )
        return r, jacobian, bias, turn, spin, turning_bias(q, v, c, c2x, c3x)

    def _local_points(self, q: Tensor, s: Tensor) -> Tensor:
        dx, dy, dl = (x.unsqueeze(-1) for x in q.unbind(-1))
        c = stumpff((dx * dx + dy * dy) * s * s)
        shape = torch.stack([dx * s * s * c[2], dy * s * s * c[2], s * c[1]], dim=-1)
        return (self.length + dl).unsqueeze(-1) * shape
