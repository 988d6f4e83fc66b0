"""Hamiltonian network with learned M^-1, V, D and A, in the state (q, p) or (q, v)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from pydantic import NonNegativeInt
from torch import Tensor

from pinn_dyn.mechanics import Integrator, State
from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models import structured
from pinn_dyn.models.cholesky import lower_solve, upper_solve
from pinn_dyn.models.friction import NoFriction
from pinn_dyn.models.statistics import Statistics


class HamiltonianNetwork(structured.StructuredNetwork):
    """Hamiltonian network with dissipation and a learned input matrix.

    The mass head gives W(q) = L L^T = M(q)^-1, as in the tables of the paper. With
    H = p^T W p / 2 + V, paper eq. (hamiltonian_dyn) reads::

        dq/dt = W p,    dp/dt = -G - d(p^T W p / 2)/dq - D W p + A u

    With ``state="qv"``, the same equations in the state (q, v), with p = W^-1 v, need no data of
    momenta, which cannot be measured::

        dq/dt = v,    dv/dt = (dW/dt) p + W dp/dt

    If A is learned in this state, the scale of the energies is arbitrary: W / c with c V, c D and
    c A gives the same motion.

    Args:
        statistics: scales of the data.
        inverse_mass, potential, damping, input, friction: builders of the heads.
        angles: coordinates that are angles. The heads use their sine and cosine.
        integrator: the integration method; Rosenbrock if damping dominates inertia.
        state: "qp" for (q, p), which needs data with momenta, or "qv" for (q, v).

    Raises:
        ValueError: if the head of the inverse mass is transposed.
    """

    def __init__(
        self,
        statistics: Statistics,
        inverse_mass: structured.CholeskyHead = structured.MASS,
        potential: structured.PotentialHead = structured.POTENTIAL,
        damping: structured.CholeskyHead = structured.DAMPING,
        input: structured.InputHead = structured.INPUT,
        friction: structured.FrictionHead = NoFriction,
        angles: Sequence[NonNegativeInt] = (),
        integrator: Integrator | None = None,
        state: State = "qp",
    ):
        heads = potential, damping, friction, input, None
        super().__init__(statistics, state, *heads, angles, integrator)
        if state == "qp":
            inverse_mass_scale = statistics.v_std / statistics.p_std
        else:
            force = self.input.typical_force(statistics.u_rms)
            inverse_mass_scale = statistics.acceleration / force
        self.inverse_mass = inverse_mass(self._scales(statistics, inverse_mass_scale.sqrt()))
        if self.inverse_mass.transposed:
            raise ValueError(
                "M^-1 = L L^T already suits chains: set model.inverse_mass.transposed=false"
            )

    def mass_matrix(self, q: Tensor) -> Tensor:
        # Avoid cholesky_inverse, whose forward-mode derivative is wrong in torch 2.13.
        factor = self.inverse_mass(q)
        eye = torch.eye(self.num_coordinates, dtype=q.dtype, device=q.device)
        inverse = torch.stack([lower_solve(factor, row.expand_as(q)) for row in eye], dim=-1)
        return inverse.transpose(-1, -2) @ inverse

    def _hamiltonian_gradient(self, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        factor, tape = self.inverse_mass.linearize(q)
        w = matvec(factor.transpose(-1, -2), p)
        kinetic = self.inverse_mass.pullback(tape, p.unsqueeze(-1) * w.unsqueeze(-2))
        return kinetic + self._potential_force(q), matvec(factor, w)

    def _momentum(self, q: Tensor, v: Tensor) -> Tensor:
        factor = self.inverse_mass(q)
        return upper_solve(factor, lower_solve(factor, v))

    def _velocity(self, q: Tensor, p: Tensor) -> Tensor:
        return self.inverse_mass.product(q, p)

    def inertial_force(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """Return M (a - (dW/dt) p) + d(p^T W p / 2)/dq, with p = M v."""
        factor, bias, mass_rate_p = self._factor_and_rates(q, v)
        return upper_solve(factor, lower_solve(factor, a - mass_rate_p)) + bias

    def _acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        factor, bias, rate_p = self._factor_and_rates(q, v)
        net_force = force - bias - self._potential_force(q)
        return rate_p + matvec(factor, matvec(factor.transpose(-1, -2), net_force))

    def _factor_and_rates(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return L, d(p^T W p / 2)/dq and (dW/dt) p, with p = M v."""
        factor, rate, tape = self.inverse_mass.linearize_along(q, v)
        w = lower_solve(factor, v)
        p = upper_solve(factor, w)
        rate_p = matvec(rate, w) + matvec(factor, matvec(rate.transpose(-1, -2), p))
        gradient = self.inverse_mass.pullback(tape, p.unsqueeze(-1) * w.unsqueeze(-2))
        return factor, gradient, rate_p
