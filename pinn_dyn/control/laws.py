"""Control laws on the terms of a mechanical system, true or learned."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from pinn_dyn.control.contracts import Controller, Motion
from pinn_dyn.exports.compiled import Compiled
from pinn_dyn.mechanics import InputSolver, MechanicalSystem
from pinn_dyn.mechanics.arrays import (
    jacobians,
    matvec,
    pseudo_inverse_times,
    require_last_dim,
)
from pinn_dyn.mechanics.input_solver import Solution

Gain = float | Sequence[float] | Tensor
"""One positive number for all coordinates, or N of them."""


class ModelBasedLaw(Controller):
    """A law u = law(q, v, q_ref, v_ref, a_ref) on the terms of a model.

    The gains are diagonal, and A^+(q) is the pseudo-inverse of the input matrix of the model.

    - Fully actuated, M = N: A^+ is the inverse, and A A^+ tau = tau.
    - Under-actuated, M < N: A A^+ tau is the orthogonal projection of tau on the range of A.
    - Over-actuated, M > N: A^+ tau is the input of least norm that gives tau.

    Inputs are infinite or NaN where A loses its rank.

    The force f(q, v, u) is not linear in u for tendons with motor positions as inputs, and for
    servos that saturate. The solution u* of f(q, v, u*) = tau then replaces A^+ tau, and the
    Jacobian J = df/du at u* replaces A. :class:`InputSolver` starts from the previous u, which is
    the only memory of the law. If there is no u*, the law returns the previous u and has a fault.
    With a model equal to the plant, the force is tau + J J^T (K_P e + K_D de/dt) up to second order
    in the feedback. Near a set point, the law is stable as with A A^T if J has full rank. This does
    not hold far from the set point or with slack tendons.

    Args:
        model: the mechanical system whose terms the law uses, in float64.
        position_gain, velocity_gain: diagonals of K_P and K_D, one number or N.
        max_condition: largest condition number of A(q), or J, that is no fault.
        solver: tolerance, steps and limits of u*, for a force that is not linear in u.

    Attributes:
        position_gain, velocity_gain: diagonals of K_P and K_D, ``(N,)``, float64.

    Raises:
        TypeError: on a model that is no mechanical system.
        ValueError: on bad gains, or a model with a residual force.
    """

    def __init__(
        self,
        model: MechanicalSystem,
        position_gain: Gain,
        velocity_gain: Gain,
        *,
        max_condition: Annotated[float, Field(ge=1)] = 1e6,
        solver: InputSolver | None = None,
    ):
        if not isinstance(model, MechanicalSystem):
            raise TypeError(
                f"model is a {type(model).__name__}, expected a system with terms M, G and A, such "
                "as model=lnn"
            )
        model.require_invertible_input()
        super().__init__(model.num_coordinates, model.num_inputs)
        self.position_gain = diagonal_gain("position_gain", position_gain, self.num_coordinates)
        self.velocity_gain = diagonal_gain("velocity_gain", velocity_gain, self.num_coordinates)
        self.model = model
        self._compiled = Compiled(type(self), model, self.position_gain, self.velocity_gain)
        self.max_condition = float(max_condition)
        self.solver = solver or InputSolver()
        self.reset()

    def reset(self) -> None:
        self._condition: Tensor | None = None
        self._previous: Tensor | None = None
        self._solution: Solution | None = None

    def __call__(self, t: float, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        """Return u ``(*batch, M)``; a reference ``(N,)`` serves the whole batch."""
        require_last_dim("q", q, self.num_coordinates, "N")
        require_last_dim("v", v, self.num_coordinates, "N")
        for name, value in zip(reference._fields, reference, strict=True):
            require_last_dim(f"reference.{name}", value, self.num_coordinates, "N")
        previous = self._previous
        if previous is not None and previous.shape[:-1] != q.shape[:-1]:
            previous = None
        with torch.no_grad():
            if self.model.input_affine and type(self).__module__ == __name__:
                u, A = self._affine_input(q, v, reference)
            else:
                u, A, self._solution = self._input(q, v, reference, previous)
            self._condition = condition_number(A)
        if not self.model.input_affine:
            self._previous = u
        return u

    def _affine_input(self, q: Tensor, v: Tensor, reference: Motion) -> tuple[Tensor, Tensor]:
        """Return u and A for a force that is linear in u, in C if that pays off."""
        rows = torch.cat([x.expand_as(q) for x in (q, v, *reference)], dim=-1)

        def function(x: Tensor) -> Tensor:
            q, v, *motion = x.chunk(5, dim=-1)
            u, A, _ = self._input(q, v, Motion(*motion), None)
            return torch.cat([u, A.flatten(-2)], dim=-1)

        u, A = self._compiled.rows("input", function, rows).split(
            [self.num_inputs, self.num_coordinates * self.num_inputs], dim=-1
        )
        return u, A.unflatten(-1, (self.num_coordinates, self.num_inputs))

    def law(
        self,
        q: Tensor,
        v: Tensor,
        q_ref: Tensor,
        v_ref: Tensor,
        a_ref: Tensor,
        u_previous: Tensor | None = None,
    ) -> Tensor:
        """Return u ``(*batch, M)`` by the formula alone, without checks and side effects.

        If the force is not linear in u, the solver takes all its steps from ``u_previous``, the u
        of the previous instant. u is NaN where no input gives the force.

        Raises:
            ValueError: on such a force without ``u_previous``.
        """
        if u_previous is None and not self.model.input_affine:
            raise ValueError(
                "the force of the model is not linear in u: the law needs u_previous, the u of the "
                "previous instant, as its sixth argument"
            )
        reference = Motion(q_ref, v_ref, a_ref)
        return self._input(q, v, reference, u_previous, all_steps=True)[0]

    @abc.abstractmethod
    def _forces(
        self, q: Tensor, v: Tensor, reference: Motion
    ) -> tuple[Tensor | None, Tensor | None]:
        """Return tau and h of u = A^+ tau + A^T h, ``(*batch, N)`` each, or None for zero."""

    def _input(
        self,
        q: Tensor,
        v: Tensor,
        reference: Motion,
        previous: Tensor | None,
        all_steps: bool = False,
    ) -> tuple[Tensor, Tensor, Solution | None]:
        """Return u, A or J ``(*batch, N, M)``, and the solution for a force not linear in u."""
        tau, feedback = self._forces(q, v, reference)
        model, solution = self.model, None
        if model.input_affine:
            A = model.input_matrix(q)
            u = A.new_zeros(A[..., 0, :].shape) if tau is None else pseudo_inverse_times(A, tau)
        elif tau is None:
            u = model.typical_input(q)
            A = jacobians(lambda x: model._applied_force(q, v, x), u)[1][0]
        else:
            tau = model._reachable_force(q, v, tau)
            solution = model.solve_input(self.solver, q, v, tau, previous, all_steps=all_steps)
            u, A = solution.u, solution.J
        if feedback is not None:
            u = u + matvec(A.transpose(-1, -2), feedback)
        if solution is not None:
            held = model.typical_input(q) if previous is None else previous
            # NaN for a NaN state, and for the formula alone.
            held = held + (torch.nan if all_steps else 0 * solution.residual.unsqueeze(-1))
            u = torch.where(solution.converged.unsqueeze(-1), u, held)
        return u, A, solution

    def _feedback(self, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        K_P, K_D = self.position_gain.to(q), self.velocity_gain.to(q)
        return K_P * (reference.q - q) + K_D * (reference.v - v)

    def diagnostics(self) -> dict[str, Tensor]:
        """Return ``input_condition``, the condition number of A(q) or J, ``(*batch,)``.

        ``input_residual`` is |f(q, v, u*) - tau| in the units of the force, not linear in u.
        """
        if self._condition is None:
            return {}
        numbers = {"input_condition": self._condition}
        if self._solution is not None:
            numbers["input_residual"] = self._solution.residual
        return numbers

    def faults(self) -> dict[str, Tensor]:
        """Return, by reason, where A(q) or J is nearly singular or NaN, or u* does not exist."""
        if self._condition is None:
            return {}
        if self._solution is not None and not self._solution.converged.all():
            reason = (
                f"no input gives the force of the law to {self.solver.tolerance:g} within "
                f"{self.solver.steps} steps, so the previous input is held"
            )
            return {reason: ~self._solution.converged}
        reason = (
            "the input matrix A(q) is nearly singular: its condition number exceeds "
            f"max_condition = {self.max_condition:g}"
        )
        return {reason: ~(self._condition <= self.max_condition)}


class ProportionalDerivative(ModelBasedLaw):
    """PD control without compensation, the feedback part of the paper's laws alone::

        u = A(q)^T (K_P (q_ref - q) + K_D (v_ref - v))

    The law uses A of the model only. For a force that is not linear in u, J at a typical input u_0
    replaces A, and u_0 is added. Arguments and errors: :class:`ModelBasedLaw`. Units of the gains
    as for :class:`Regulation`.
    """

    def _forces(self, q: Tensor, v: Tensor, reference: Motion) -> tuple[None, Tensor]:
        return None, self._feedback(q, v, reference)


class Regulation(ModelBasedLaw):
    """Regulation to a constant configuration, PD with gravity compensation.

    Paper eq. (controller_PD), after Tomei 1991::

        u = A^+(q) G(q) + A(q)^T (K_P (q_ref - q) + K_D (v_ref - v))

    Stability is shown for M = N, A of full rank and v_ref = 0 (paper, Corollary on perfect
    learning: the terms may be those of the plant times one common matrix P(q)). Arguments and
    errors: :class:`ModelBasedLaw`. K_P in N/m or Nm/rad and K_D in Ns/m or Nms/rad where A has no
    unit.
    """

    def _forces(self, q: Tensor, v: Tensor, reference: Motion) -> tuple[Tensor, Tensor]:
        return self.model.potential_force(q), self._feedback(q, v, reference)


class Tracking(ModelBasedLaw):
    """Tracking of a desired motion, PD with its feed-forward.

    Paper eq. (controller), PD control with computed feed-forward (Kelly and Salgado 1994)::

        u = A^+(q) (M(q_r) a_r + C(q_r, v_r) v_r + D(q_r) v_r + F(v_r) + G(q_r))
            + A(q)^T (K_P (q_r - q) + K_D (v_r - v))

    with the dry friction F of the model and C v = (dM/dt) v - d(v^T M v / 2)/dq. The paper takes C
    from d2L/(dq dv), which gives (dM/dt) v alone. Arguments and errors: :class:`ModelBasedLaw`.
    Units of the gains as for :class:`Regulation`.
    """

    def _forces(self, q: Tensor, v: Tensor, reference: Motion) -> tuple[Tensor, Tensor]:
        return self.model.inverse_dynamics(*reference), self._feedback(q, v, reference)


class ComputedTorque(ModelBasedLaw):
    """Computed torque, inverse dynamics control (Spong, Hutchinson, Vidyasagar 2006, ch. 8)::

        u = A^+(q) (M(q) a + C(q, v) v + G(q) + D(q) v + F(v)),
        a = a_r + K_D (v_r - v) + K_P (q_r - q)

    With the true terms, M = N and A of full rank, the error e = q_r - q obeys
    d2e/dt2 = -K_D de/dt - K_P e: K_P in 1/s^2 and K_D in 1/s; K_D = 2 sqrt(K_P) is critically
    damped. Arguments and errors: :class:`ModelBasedLaw`.
    """

    def _forces(self, q: Tensor, v: Tensor, reference: Motion) -> tuple[Tensor, None]:
        a = reference.a + self._feedback(q, v, reference)
        return self.model.inverse_dynamics(q, v, a), None


def condition_number(A: Tensor) -> Tensor:
    """Return the condition number of A, ``(*batch,)``; NaN where A is zero or not finite."""
    # svdvals refuses a whole batch for one NaN, so it gets none; the sum brings the NaN back.
    values = torch.linalg.svdvals(torch.nan_to_num(A, nan=0.0, posinf=0.0, neginf=0.0))
    return values[..., 0] / values[..., -1] + 0 * A.sum((-2, -1))


def diagonal_gain(name: str, value: Gain, size: int) -> Tensor:
    """Return the diagonal of a positive definite gain matrix, ``(size,)``, float64."""
    gain = torch.as_tensor(value, dtype=torch.float64)
    if gain.shape not in ((), (size,)) or not (gain.isfinite() & (gain > 0)).all():
        raise ValueError(f"{name} is {gain.tolist()}, expected 1 or {size} positive numbers")
    return gain.expand(size).clone()
