"""Lagrangian network with learned M, V, D and A, in the state (q, v)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from pydantic import NonNegativeInt
from torch import Tensor

from pinn_dyn.mechanics import Integrator
from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models import structured
from pinn_dyn.models.cholesky import lower_solve, upper_solve
from pinn_dyn.models.friction import NoFriction
from pinn_dyn.models.initial_velocity import InitialVelocityHead, start_of
from pinn_dyn.models.mlp import Tape
from pinn_dyn.models.residual import ResidualHead
from pinn_dyn.models.statistics import Statistics


class LagrangianNetwork(structured.StructuredNetwork):
    """Lagrangian network with dissipation and a learned input matrix.

    The acceleration follows from paper eq. (armdynamics). For L(q, v) = v^T M v / 2 - V, with
    friction F and a residual force r::

        M a = A u + r - D v - F(v) - G - (dM/dt) v + d(v^T M v / 2)/dq

    One tangent pass and one reverse pass through the mass head M = L L^T replace the Hessian of the
    Lagrangian. Two triangular solves with the factor L replace the inverse of M.

    Args:
        statistics: scales of the data.
        mass, potential, damping, input, friction, residual, initial_velocity: builders of heads.
        angles: coordinates that are angles. The heads use their sine and cosine.
        integrator: the integration method; Rosenbrock if damping dominates inertia.

    Raises:
        ValueError: if the mass head is for a chain but not transposed.
    """

    def __init__(
        self,
        statistics: Statistics,
        mass: structured.CholeskyHead = structured.MASS,
        potential: structured.PotentialHead = structured.POTENTIAL,
        damping: structured.CholeskyHead = structured.DAMPING,
        input: structured.InputHead = structured.INPUT,
        friction: structured.FrictionHead = NoFriction,
        residual: ResidualHead | None = None,
        initial_velocity: InitialVelocityHead | None = None,
        angles: Sequence[NonNegativeInt] = (),
        integrator: Integrator | None = None,
    ):
        heads = potential, damping, friction, input, residual
        super().__init__(statistics, "qv", *heads, angles, integrator)
        inertia = self.input.typical_force(statistics.u_rms) / statistics.acceleration
        self.mass = mass(self._scales(statistics, inertia.sqrt()))
        if self.mass.chain and not self.mass.transposed:
            raise ValueError(
                "model.mass.chain is true, which is correct for M = L^T L, but not for M = L L^T: "
                "set model.mass.transposed=true"
            )
        scales = self._scales(statistics, statistics.v_std)
        self.initial_velocity = initial_velocity and initial_velocity(scales)
        self.learns_initial_state = initial_velocity is not None

    def initial_state(self, x0: Tensor, u0: Tensor) -> Tensor:
        return start_of(self.initial_velocity, x0, u0)

    def mass_matrix(self, q: Tensor) -> Tensor:
        return self.mass.matrix(q)

    def inertial_force(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        factor, bias = self._factor_and_coriolis_force(q, v)
        root = self._root(factor)
        return matvec(root.transpose(-1, -2), matvec(root, a)) + bias

    def mass_and_bias(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        factor, bias = self._factor_and_coriolis_force(q, v)
        root = self._root(factor)
        return root.transpose(-1, -2) @ root, bias + self._potential_force(q)

    def _acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        factor, bias = self._factor_and_coriolis_force(q, v)
        return self._solve(factor, force - bias - self._potential_force(q))

    def _velocity(self, q: Tensor, p: Tensor) -> Tensor:
        return self._solve(self.mass(q), p)

    def _factor_and_coriolis_force(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Return L and C v = (dR^T R + R^T dR) v - d(|R v|^2 / 2)/dq with M = R^T R, dR along v."""
        if self.mass.constant:
            return self.mass(q), torch.zeros_like(q)
        factor, factor_rate, tape = self.mass.linearize_along(q, v)
        root, rate = self._root(factor), self._root(factor_rate)
        w = matvec(root, v)
        mass_rate_v = matvec(rate.transpose(-1, -2), w)
        mass_rate_v = mass_rate_v + matvec(root.transpose(-1, -2), matvec(rate, v))
        return factor, mass_rate_v - self._energy_gradient(tape, v, w)

    def _root(self, factor: Tensor) -> Tensor:
        """Return R with M = R^T R: R = L^T, or R = L for a transposed head."""
        return factor if self.mass.transposed else factor.transpose(-1, -2)

    def _energy_gradient(self, tape: Tape, v: Tensor, w: Tensor) -> Tensor:
        left, right = (w, v) if self.mass.transposed else (v, w)
        return self.mass.pullback(tape, left.unsqueeze(-1) * right.unsqueeze(-2))

    def _solve(self, factor: Tensor, force: Tensor) -> Tensor:
        if self.mass.transposed:
            return lower_solve(factor, upper_solve(factor, force))
        return upper_solve(factor, lower_solve(factor, force))
