"""The contract of mechanical systems, analytic and learned."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, final

import torch
from torch import Tensor

from pinn_dyn.mechanics.arrays import (
    matvec,
    pseudo_inverse_times,
    require_last_dim,
    spd_solver,
)
from pinn_dyn.mechanics.input_solver import InputSolver, Solution
from pinn_dyn.mechanics.mechanical_terms import MechanicalTerms
from pinn_dyn.mechanics.sliding import Sliding


class Terms(NamedTuple):
    """Mass matrix M, damping matrix D, potential force G and input matrix A at a configuration."""

    M: Tensor
    D: Tensor
    G: Tensor
    A: Tensor


class MechanicalSystem(MechanicalTerms):
    """A mechanical system with dissipation and an input matrix.

    Lagrangian form, paper eq. (armdynamics)::

        M(q) dv/dt + C(q, v) v + G(q) + D(q) v + F(v) = A(q) u + r,      G = dV/dq

    Hamiltonian form, paper eq. (hamiltonian_dyn), with p = M(q) v::

        dq/dt = dH/dp,   dp/dt = -dH/dq - D(q) v - F(v) + A(q) u + r,  v = dH/dp

    F(v) is dry friction, with v^T F(v) >= 0. With ``sticking`` friction, coordinates stick
    in rollouts (:class:`~.integrators.Sticking`). r(q, v, u) is a residual force for effects that
    are not mechanical (``has_residual``). Both are zero by default, as in the paper.

    Symbols: q configuration ``(*batch, N)``, v velocity ``(*batch, N)``, a acceleration
    ``(*batch, N)``, p momentum ``(*batch, N)``, u input ``(*batch, M)``, tau = A(q) u generalized
    force ``(*batch, N)``; SI units and radians.

    If the force is not linear in the input, ``input_affine`` is false, and :meth:`input_matrix` is
    A at :meth:`typical_input`.

    A subclass implements the four abstract terms, see :class:`MechanicalTerms`.
    """

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Tensor:
            """Return a buffer or a parameter."""

    @final
    def terms(self, q: Tensor) -> Terms:
        """Return M(q), D(q), G(q) and A(q) together."""
        self._check(q=q)
        mass, damping = self.mass_matrix(q), self.damping_matrix(q)
        return Terms(mass, damping, self._potential_force(q), self.input_matrix(q))

    @final
    def potential_force(self, q: Tensor) -> Tensor:
        """Return G(q) = dV/dq, ``(*batch, N)``."""
        self._check(q=q)
        return self._potential_force(q)

    @final
    def dissipative_force(self, q: Tensor, v: Tensor) -> Tensor:
        """Return D(q) v + F(v), ``(*batch, N)``; its power v^T D v + v^T F(v) is never negative."""
        self._check(q=q, v=v)
        return self.damping_force(q, v) + self.friction_force(v)

    @final
    def coriolis_matrix(self, q: Tensor, v: Tensor) -> Tensor:
        """Return C(q, v), ``(*batch, N, N)``, from the Christoffel symbols of the first kind::

        C_ij = sum_k (dM_ij/dq_k + dM_ik/dq_j - dM_jk/dq_i) v_k / 2

        """
        self._check(q=q, v=v)
        basis = torch.eye(self.num_coordinates, dtype=q.dtype, device=q.device)
        directions = [row.expand_as(q) for row in basis]
        rates = [torch.func.jvp(self.mass_matrix, (q,), (e,))[1] for e in directions]
        slopes = torch.stack(rates, dim=-1)  # (*batch, i, j, k) = dM_ij / dq_k
        symbols = slopes + slopes.transpose(-1, -2) - slopes.movedim(-1, -3)
        return 0.5 * matvec(symbols, v.unsqueeze(-2))

    @final
    def residual_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return r(q, v, u), ``(*batch, N)``."""
        self._check(q=q, v=v, u=u)
        return self._residual_force(q, v, u)

    @final
    def forward_dynamics(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return M^-1 (A u + r - C v - G - D v - F), ``(*batch, N)``; paper eq. (armdynamics)."""
        self._check(q=q, v=v, u=u)
        force = self.applied_force(q, v, u) - self.dissipative_force(q, v)
        return self._acceleration(q, v, force)

    @final
    def inverse_dynamics(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """Return tau = M a + C v + G + D v + F, ``(*batch, N)``, the force A u + r for ``a``."""
        self._check(q=q, v=v, a=a)
        conservative = self.inertial_force(q, v, a) + self._potential_force(q)
        return conservative + self.dissipative_force(q, v)

    @final
    def input_for(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """Return u = A(q)^+ tau with tau = :meth:`inverse_dynamics`, ``(*batch, M)``.

        - M = N: A u = tau.
        - M > N, over-actuated: the u of least norm with A u = tau.
        - M < N, under-actuated: the u of least ``|A u - tau|``. The acceleration is ``a`` only if
          tau lies in the range of A.

        If the force is not linear in u, :class:`InputSolver` finds u; for M > N, the solution
        closest to :meth:`typical_input`. Entries are infinite or NaN where A is rank-deficient or
        no input gives the force.

        Raises:
            ValueError: if a shape is wrong, or as :meth:`require_invertible_input`.
        """
        self.require_invertible_input()
        tau = self.inverse_dynamics(q, v, a)
        if self.input_affine:
            return pseudo_inverse_times(self.input_matrix(q), tau)
        solution = self.solve_input(InputSolver(), q, v, tau)
        return torch.where(solution.converged.unsqueeze(-1), solution.u, torch.nan)

    @final
    def solve_input(
        self,
        solver: InputSolver,
        q: Tensor,
        v: Tensor,
        tau: Tensor,
        previous: Tensor | None = None,
        *,
        all_steps: bool = False,
    ) -> Solution:
        """Return the input that gives the force tau ``(*batch, N)``, see :class:`InputSolver`."""
        force = partial(self.applied_force, q, v)
        return solver(force, tau, self.typical_input(q), previous, all_steps=all_steps)

    @final
    def require_invertible_input(self) -> None:
        """Check that the model has inputs and no residual force, which may depend on u.

        Raises:
            ValueError: if the model has no inputs, or has a residual force.
        """
        if not self.num_inputs:
            raise ValueError("the model has no inputs (u: []), so no control law can move it")
        if self.has_residual:
            raise ValueError(
                "the model has a residual force, which A(q) cannot invert: train with "
                "~model/residual"
            )

    @final
    def momentum(self, q: Tensor, v: Tensor) -> Tensor:
        """Return p = M(q) v, ``(*batch, N)``."""
        self._check(q=q, v=v)
        return self._momentum(q, v)

    @final
    def velocity(self, q: Tensor, p: Tensor) -> Tensor:
        """Return v = M(q)^-1 p, ``(*batch, N)``."""
        self._check(q=q, p=p)
        return self._velocity(q, p)

    @final
    def kinetic_energy(self, q: Tensor, v: Tensor) -> Tensor:
        """Return T = v^T M(q) v / 2, ``(*batch,)``, J."""
        return 0.5 * (self.momentum(q, v) * v).sum(-1)

    @final
    def total_energy(self, q: Tensor, v: Tensor) -> Tensor:
        """Return E = T + V, ``(*batch,)``, J."""
        return self.kinetic_energy(q, v) + self.potential_energy(q)

    @final
    def power(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return dE/dt = v^T (A u + r) - v^T (D v + F), ``(*batch,)``, W: supply minus losses."""
        self._check(q=q, v=v, u=u)
        supplied = self.applied_force(q, v, u) - self.dissipative_force(q, v)
        return (v * supplied).sum(-1)

    @final
    def velocity_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """Return d(q, v)/dt, ``(*batch, 2N)``, in Lagrangian form."""
        q, v = x.chunk(2, dim=-1)
        return torch.cat([v, self.forward_dynamics(q, v, u)], dim=-1)

    @final
    def momentum_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """Return d(q, p)/dt, ``(*batch, 2N)``, in Hamiltonian form."""
        q, p = x.chunk(2, dim=-1)
        self._check(q=q, p=p, u=u)
        grad_q, v = self._hamiltonian_gradient(q, p)
        force = self.applied_force(q, v, u) - self.dissipative_force(q, v)
        return torch.cat([v, force - grad_q], dim=-1)

    @final
    def state_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """Return dx/dt of the state of this system, (q, v) or (q, p)."""
        if self.state == "qp":
            return self.momentum_derivative(x, u)
        return self.velocity_derivative(x, u)

    @final
    def sliding(self, x: Tensor, inputs: Tensor, h: Tensor, implicit: bool) -> Sliding:
        """Return the dynamics with sticking friction of a step from x that lasts h, ``()``, s."""
        return Sliding(self, x, inputs, h, implicit)

    @final
    def implicit_solver(self, x: Tensor, step: Tensor) -> Callable[[Tensor], Tensor]:
        """Return a function from r to k with (1 - s J) k = r, where J has the stiff terms::

            (q, v):  J = [[0, 1], [-M^-1 K, -M^-1 D']]     (q, p):  J = [[0, M^-1], [-K, -D' M^-1]]

        D' = D + diag(dF_i/dv_i), and K is the stiffness of drives and elastic joints. With
        r = (r_q, r_v) or (r_q, r_p), r_p = M r_v and E = (M + s D' + s^2 K)^-1, the solution is
        k_v = E (r_p - s K r_q), k_p = M k_v and k_q = r_q + s k_v.
        """
        q, v = x.chunk(2, dim=-1)
        if self.state == "qp":
            v = self._velocity(q, v)
        mass, stiffness = self.mass_matrix(q), self.stiffness_matrix(q)
        resistance = self.resistance_matrix(q, step) + torch.diag_embed(self.friction_slope(v))
        inverse = spd_solver(mass + step * resistance)

        def solve(rate: Tensor) -> Tensor:
            rate_q, rate = rate.chunk(2, dim=-1)
            force = matvec(mass, rate) if self.state == "qv" else rate
            if stiffness is not None:
                force = force - step * matvec(stiffness, rate_q)
            velocity = inverse(force)
            rate = velocity if self.state == "qv" else matvec(mass, velocity)
            return torch.cat([rate_q + step * velocity, rate], dim=-1)

        return solve

    def _check(self, **values: Tensor) -> None:
        for name, value in values.items():
            size, symbol = (self.num_inputs, "M") if name == "u" else (self.num_coordinates, "N")
            require_last_dim(name, value, size, symbol)
