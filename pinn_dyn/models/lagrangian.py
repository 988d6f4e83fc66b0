"""The Lagrangian network: learns M, V, D and A; its state is (q, v)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models.friction import NoFriction
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.models.structured import (
    CholeskyHead,
    FrictionHead,
    InputHead,
    PotentialHead,
    StructuredNetwork,
    lower_solve,
    upper_solve,
)


class LagrangianNetwork(StructuredNetwork):
    """Lagrangian network with dissipation and a learned input matrix.

    Heads give M = L L^T, V, D = L_D L_D^T, A and a friction F; the acceleration follows from paper
    eq. (armdynamics), which for L(q, v) = v^T M v / 2 - V reads::

        M a = A u - D v - F(v) - G - (dM/dt) v + d(v^T M v / 2)/dq

    One tangent pass (dL/dt) and one reverse pass (the last term, through |L^T v|^2 / 2) through the
    mass head take the place of the Hessian of the Lagrangian, and two triangular solves with the
    head's own factor L that of the inverse of M.

    Args:
        statistics: scales of the data.
        mass, potential, damping, input, friction: builders of the heads.
        angles: which coordinates are angles; the heads see their sine and cosine.
        substeps: RK4 steps within a step of the data.
    """

    def __init__(
        self,
        statistics: Statistics,
        mass: CholeskyHead,
        potential: PotentialHead,
        damping: CholeskyHead,
        input: InputHead,
        friction: FrictionHead = NoFriction,
        angles: Sequence[int] = (),
        substeps: int = 1,
    ):
        super().__init__(
            statistics, "velocity", potential, damping, friction, input, angles, substeps
        )
        size = self.num_coordinates
        acceleration = statistics.velocity_increment_std[0, size:] / statistics.step
        self.mass = mass(
            size=size,
            scale=(self.input.typical_force(statistics.u_rms) / acceleration).sqrt(),
            mean=statistics.q_mean,
            std=statistics.q_std,
            angles=angles,
        )

    def mass_matrix(self, q: Tensor) -> Tensor:
        """M(q) = L L^T, ``(*batch, N, N)``."""
        return self.mass.matrix(q)

    def _inertial_force(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        factor, bias = self._factor_and_coriolis_force(q, v)
        return matvec(factor, matvec(factor.transpose(-1, -2), a)) + bias

    def _acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        factor, bias = self._factor_and_coriolis_force(q, v)
        return upper_solve(factor, lower_solve(factor, force - bias - self._potential_force(q)))

    def _velocity(self, q: Tensor, p: Tensor) -> Tensor:
        factor = self.mass(q)
        return upper_solve(factor, lower_solve(factor, p))

    def _kinetic_gradient(self, q: Tensor, v: Tensor) -> Tensor:
        factor, tape = self.mass.linearize(q)
        w = matvec(factor.transpose(-1, -2), v)
        return self.mass.pullback(tape, v.unsqueeze(-1) * w.unsqueeze(-2))

    def _factor_and_coriolis_force(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """L and C v = (dL L^T + L dL^T) v - d(|L^T v|^2 / 2)/dq, with dL along v."""
        factor, tape = self.mass.linearize(q)
        rate = self.mass.pushforward(tape, v)
        w = matvec(factor.transpose(-1, -2), v)
        mass_rate_v = matvec(rate, w) + matvec(factor, matvec(rate.transpose(-1, -2), v))
        gradient = self.mass.pullback(tape, v.unsqueeze(-1) * w.unsqueeze(-2))
        return factor, mass_rate_v - gradient
