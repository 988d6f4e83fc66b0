"""The terms of a mechanical system that define it, and their derivatives."""

from __future__ import annotations

import abc

import torch
from torch import Tensor

from pinn_dyn.mechanics.arrays import matvec, spd_solve
from pinn_dyn.mechanics.predictor import ContinuousPredictor


class MechanicalTerms(ContinuousPredictor):
    """Terms of a :class:`~.system.MechanicalSystem`, without checks of shapes.

    A subclass implements the four abstract terms. All other terms follow by automatic
    differentiation. A subclass with closed formulas may override them.
    """

    input_affine: bool = True
    sticking: bool = False
    has_residual: bool = False

    @abc.abstractmethod
    def mass_matrix(self, q: Tensor) -> Tensor:
        """Return M(q), ``(*batch, N, N)``, symmetric positive definite."""

    @abc.abstractmethod
    def potential_energy(self, q: Tensor) -> Tensor:
        """Return V(q), ``(*batch,)``, J."""

    @abc.abstractmethod
    def damping_matrix(self, q: Tensor) -> Tensor:
        """Return D(q), ``(*batch, N, N)``, symmetric positive semi-definite."""

    @abc.abstractmethod
    def input_matrix(self, q: Tensor) -> Tensor:
        """Return A(q), ``(*batch, N, M)``."""

    def typical_input(self, q: Tensor) -> Tensor:
        """Return a typical input ``(*batch, M)``, the start of an :class:`~.InputSolver`."""
        return q.new_zeros(*q.shape[:-1], self.num_inputs)

    def _potential_force(self, q: Tensor) -> Tensor:
        return torch.func.grad(lambda x: self.potential_energy(x).sum())(q)

    def inertial_force(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """Return M(q) a + C(q, v) v, with C(q, v) v = (dM/dt) v - d(v^T M v / 2)/dq."""
        mass, mass_rate = torch.func.jvp(self.mass_matrix, (q,), (v,))  # type: ignore[misc]
        return matvec(mass, a) + matvec(mass_rate, v) - self._kinetic_gradient(q, v)

    def _acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        """Solve M(q) a + C(q, v) v + G(q) = force for a."""
        mass, bias = self.mass_and_bias(q, v)
        return spd_solve(mass, force - bias)

    def mass_and_bias(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Return M(q) and C(q, v) v + G(q)."""
        bias = self.inertial_force(q, v, torch.zeros_like(v)) + self._potential_force(q)
        return self.mass_matrix(q), bias

    def damping_force(self, q: Tensor, v: Tensor) -> Tensor:
        """Return D(q) v, ``(*batch, N)``."""
        return matvec(self.damping_matrix(q), v)

    def friction_force(self, v: Tensor) -> Tensor:
        """Return the dry friction F(v), ``(*batch, N)``."""
        return torch.zeros_like(v)

    def friction_slope(self, v: Tensor) -> Tensor:
        """Return dF_i/dv_i, ``(*batch, N)``."""
        return torch.zeros_like(v)

    def sliding_force(self, v: Tensor, share: Tensor) -> Tensor:
        """Return the friction of sliding coordinates, ``(*batch, N)``.

        ``share`` (0 to 1) is the part of the time in which a coordinate slides forward.
        """
        return self.friction_force(v)

    def stiffness_matrix(self, q: Tensor) -> Tensor | None:
        """Return the stiff part K(q) of dG/dq for implicit methods, ``(*batch, N, N)``, or None."""
        return None

    def largest_input(self) -> Tensor | None:
        """Return the inputs at which the force of the drives saturates, ``(M,)``, or None."""
        return None

    def input_force(self, q: Tensor, u: Tensor) -> Tensor:
        """Return A(q) u, ``(*batch, N)``."""
        return matvec(self.input_matrix(q), u)

    def _residual_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return torch.zeros_like(v)

    def applied_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return the force of the inputs and the residual force, ``(*batch, N)``."""
        force = self.input_force(q, u)
        return force + self._residual_force(q, v, u) if self.has_residual else force

    def reachable_force(self, q: Tensor, v: Tensor, tau: Tensor) -> Tensor:
        """Return the force closest to tau that the drives can exert, ``(*batch, N)``."""
        return tau

    def _hamiltonian_gradient(self, q: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        """Return dH/dq = G(q) - d(v^T M v / 2)/dq at fixed v, and dH/dp = M^-1 p = v."""
        v = self._velocity(q, p)
        return self._potential_force(q) - self._kinetic_gradient(q, v), v

    def _momentum(self, q: Tensor, v: Tensor) -> Tensor:
        return matvec(self.mass_matrix(q), v)

    def _velocity(self, q: Tensor, p: Tensor) -> Tensor:
        return spd_solve(self.mass_matrix(q), p)

    def _kinetic_gradient(self, q: Tensor, v: Tensor) -> Tensor:
        """Return d(v^T M(q) v / 2)/dq at fixed v."""
        return torch.func.grad(lambda x: 0.5 * (v * matvec(self.mass_matrix(x), v)).sum())(q)

    def resistance_matrix(self, q: Tensor, step: Tensor) -> Tensor:
        """Return D(q) + s K(q), ``(*batch, N, N)``, with the time s = ``step``, ``()``, s."""
        damping, stiffness = self.damping_matrix(q), self.stiffness_matrix(q)
        return damping if stiffness is None else damping + step * stiffness
