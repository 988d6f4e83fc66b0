"""Control laws from the terms of a mechanical system, analytic or learned."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Annotated

import torch
from pydantic import Field, NonNegativeFloat
from torch import Tensor

from pinn_dyn.control.contracts import Motion, Stage, Step, is_applied
from pinn_dyn.exports.program import is_traced
from pinn_dyn.mechanics import InputSolver, MechanicalSystem
from pinn_dyn.mechanics.arrays import jacobians, matvec, pseudo_inverse_times

Gain = float | Sequence[float] | Tensor
"""One positive number for all coordinates, or N of them."""


class ModelBasedLaw(Stage):
    """A law u = law(q, v, q_ref, v_ref, a_ref) from the terms of a model.

    The gains are diagonal, and A^+(q) is the pseudo-inverse of the input matrix of the model.

    - Fully actuated, M = N: A^+ is the inverse, and A A^+ tau = tau.
    - Under-actuated, M < N: A A^+ tau is the orthogonal projection of tau on the range of A.
    - Over-actuated, M > N: A^+ tau is the input of least norm that gives tau.

    Inputs are infinite or NaN where A is rank-deficient.

    The force f(q, v, u) is not linear in u for tendons with motor positions as inputs, and for
    drives that saturate. The solution u* of f(q, v, u*) = tau then replaces A^+ tau, and the
    Jacobian J = df/du at u* replaces A. :class:`InputSolver` starts from the last input. If there
    is no u*, the law returns the last input and sets the mark ``unreachable``.

    If the model equals the plant, the force is tau + J J^T (K_P e + K_D de/dt) up to second order
    in the feedback. Near a set point, the law is then stable if J has full rank, as with A A^T.
    This does not hold far from the set point or with slack tendons.

    The report has ``input_condition``, the :func:`condition_number` of A(q) or J; ``singular``,
    true above ``max_condition``; and, if the force is not linear in u, ``input_residual``,
    |f(q, v, u*) - tau| in the units of the force.

    Args:
        model: the mechanical system whose terms the law uses, in float64.
        position_gain, velocity_gain: diagonals of K_P and K_D, one number or N.
        max_condition: largest allowed condition number of A(q) or J.
        solver: solver for u*, for a force that is not linear in u.

    Attributes:
        position_gain, velocity_gain: diagonals of K_P and K_D, ``(N,)``, float64.

    Raises:
        TypeError: if the model is not a mechanical system.
        ValueError: if a gain is not positive, or the model has a residual force or no inputs.
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
        self.is_long = not model.input_affine  # exported code contains all steps of the solver
        self.max_condition = float(max_condition)
        self.solver = solver or InputSolver()

    def step(
        self, q: Tensor, v: Tensor, reference: Motion, applied: Tensor, memory: Tensor
    ) -> Step:
        """Return u ``(*batch, M)``; a reference ``(N,)`` serves the whole batch."""
        tau, feedback = self._forces(q, v, reference)
        return self._input(q, v, tau, feedback, applied, memory)

    def stiffness(self) -> tuple[Tensor, Tensor] | None:
        return self.position_gain, self.velocity_gain

    @abc.abstractmethod
    def _forces(
        self, q: Tensor, v: Tensor, reference: Motion
    ) -> tuple[Tensor | None, Tensor | None]:
        """Return tau and h in u = A^+ tau + A^T h, ``(*batch, N)`` each, or None for zero."""

    def _input(
        self,
        q: Tensor,
        v: Tensor,
        tau: Tensor | None,
        feedback: Tensor | None,
        applied: Tensor,
        memory: Tensor,
    ) -> Step:
        model, solution = self.model, None
        if model.input_affine:
            A = model.input_matrix(q)
            u = A.new_zeros(A[..., 0, :].shape) if tau is None else pseudo_inverse_times(A, tau)
        elif tau is None:
            u = model.typical_input(q)
            A = jacobians(lambda x: model.applied_force(q, v, x), u)[1][0]
        else:
            tau = model.reachable_force(q, v, tau)
            solution = model.solve_input(self.solver, q, v, tau, applied, all_steps=is_traced())
            u, A = solution.u, solution.J
        if feedback is not None:
            u = u + matvec(A.transpose(-1, -2), feedback)
        condition = condition_number(A)
        report = {"input_condition": condition, "singular": ~(condition <= self.max_condition)}
        if solution is not None:
            missing = ~solution.converged
            held = applied + 0 * solution.residual.unsqueeze(-1)  # a NaN state gives NaN
            u = torch.where(missing.unsqueeze(-1), held, u)
            report = {**report, "input_residual": solution.residual, "unreachable": missing}
        return Step(u, memory, report)

    def _feedback(self, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        K_P, K_D = self.position_gain.to(q), self.velocity_gain.to(q)
        return K_P * (reference.q - q) + K_D * (reference.v - v)


class ProportionalDerivative(ModelBasedLaw):
    """PD control without compensation, the feedback part of the paper's laws::

        u = A(q)^T (K_P (q_ref - q) + K_D (v_ref - v))

    The law uses only A of the model. For a force that is not linear in u, J at a typical input u_0
    replaces A, and u_0 is added to u. Arguments and errors: :class:`ModelBasedLaw`. Units of the
    gains as for :class:`Regulation`.
    """

    def _forces(self, q: Tensor, v: Tensor, reference: Motion) -> tuple[None, Tensor]:
        return None, self._feedback(q, v, reference)


class Regulation(ModelBasedLaw):
    """Regulation to a constant configuration, PD with gravity compensation.

    Paper eq. (controller_PD), after Tomei 1991::

        u = A^+(q) G(q) + A(q)^T (K_P (q_ref - q) + K_D (v_ref - v))

    Stability is proven for M = N, A of full rank and v_ref = 0. The terms may be those of the plant
    times a common matrix P(q) (paper, Corollary on perfect learning). Arguments and errors:
    :class:`ModelBasedLaw`. If A has no unit, K_P is in N/m or Nm/rad and K_D in Ns/m or Nms/rad.
    """

    def _forces(self, q: Tensor, v: Tensor, reference: Motion) -> tuple[Tensor, Tensor]:
        return self.model.potential_force(q), self._feedback(q, v, reference)


class Tracking(ModelBasedLaw):
    """Tracking of a desired motion by PD control with feed-forward.

    Paper eq. (controller), PD control with computed feed-forward (Kelly and Salgado 1994)::

        u = A^+(q) (M(q_r) a_r + C(q_r, v_r) v_r + D(q_r) v_r + F(v_r) + G(q_r))
            + A(q)^T (K_P (q_r - q) + K_D (v_r - v))

    with the dry friction F of the model and C v = (dM/dt) v - d(v^T M v / 2)/dq. The paper computes
    C from d2L/(dq dv), which gives only (dM/dt) v. Arguments and errors: :class:`ModelBasedLaw`.
    Units of the gains as for :class:`Regulation`.
    """

    def _forces(self, q: Tensor, v: Tensor, reference: Motion) -> tuple[Tensor, Tensor]:
        return self.model.inverse_dynamics(*reference), self._feedback(q, v, reference)


class ComputedTorque(ModelBasedLaw):
    """Computed-torque control (Spong, Hutchinson, Vidyasagar 2006, ch. 8)::

        u = A^+(q) (M(q) a + C(q, v) v + G(q) + D(q) v + F(v)),
        a = a_r + K_D (v_r - v) + K_P (q_r - q)

    With the true terms, M = N and A of full rank, the error e = q_r - q obeys
    d2e/dt2 = -K_D de/dt - K_P e: K_P in 1/s^2 and K_D in 1/s; K_D = 2 sqrt(K_P) is critically
    damped. Arguments and errors: :class:`ModelBasedLaw`.
    """

    def stiffness(self) -> None:
        """Return None: the gains are in 1/s^2 and 1/s."""

    def _forces(self, q: Tensor, v: Tensor, reference: Motion) -> tuple[Tensor, None]:
        a = reference.a + self._feedback(q, v, reference)
        return self.model.inverse_dynamics(q, v, a), None


def condition_number(A: Tensor) -> Tensor:
    """Return |A| |A^+| / r in the Frobenius norm, with r = min(N, M), ``(*batch,)``.

    The number is 1 for an orthogonal matrix, and otherwise between 1/r and 1 times the ratio of the
    extreme singular values. It is infinite or NaN where A is rank-deficient or not finite.
    """
    square = A.mT @ A if A.shape[-1] < A.shape[-2] else A @ A.mT
    size = square.shape[-1]
    factor, failed = torch.linalg.cholesky_ex(square)
    inverse = torch.linalg.solve_triangular(factor, torch.eye(size).to(A), upper=False)
    product = A.square().sum((-2, -1)) * inverse.square().sum((-2, -1))
    return torch.where(failed == 0, product.sqrt() / size, torch.inf)


def diagonal_gain(name: str, value: Gain, size: int) -> Tensor:
    """Return the diagonal of a positive definite gain matrix, ``(size,)``, float64."""
    gain = torch.as_tensor(value, dtype=torch.float64)
    if gain.shape not in ((), (size,)) or not (gain.isfinite() & (gain > 0)).all():
        raise ValueError(f"{name} is {gain.tolist()}, expected 1 or {size} positive numbers")
    return gain.expand(size).clone()


_RANK = 1e-15  # singular values below this share of the largest are zero


class MotorPID(Stage):
    """PID control of motors whose positions are the inputs::

        u = u_0 + J^+ (K_P e + K_I integral of e dt - K_D v),    e = q_ref - q

    Symbols: J = dq/du ``(N, M)``, the static gain of the model at the first configuration and its
    typical input u_0. Both stay constant. The integral is held while an input is limited. The law
    is a baseline for :class:`~.latent_law.LatentLaw`.

    Args:
        model: the mechanical system that gives J and u_0.
        position_gain, velocity_gain, integral_gain: K_P without a unit, K_D in s, K_I in 1/s.
    """

    needs_period = True

    def __init__(
        self,
        model: MechanicalSystem,
        position_gain: NonNegativeFloat = 0.5,
        velocity_gain: NonNegativeFloat = 0.0,
        integral_gain: NonNegativeFloat = 5.0,
    ):
        super().__init__(model.num_coordinates, model.num_inputs)
        self.model = model
        self.gains = position_gain, velocity_gain, integral_gain
        n, m = self.num_coordinates, self.num_inputs
        self._sizes = [n, m, m, m * n]
        self.memory_size = sum(self._sizes)

    def start(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return the memory: a zero integral, no previous u, u_0 and J^+."""
        model = self.model

        def force(q: Tensor, u: Tensor) -> Tensor:
            return model.applied_force(q, torch.zeros_like(q), u) - model.potential_force(q)

        typical = model.typical_input(q)
        _, (stiffness, slope) = jacobians(force, q, typical)
        inverse = torch.linalg.pinv(-torch.linalg.solve(stiffness, slope), rtol=_RANK)
        last_u = torch.full_like(u, torch.nan)  # the first call does not integrate
        return torch.cat([torch.zeros_like(q), last_u, typical, inverse.flatten(-2)], dim=-1)

    def step(
        self, q: Tensor, v: Tensor, reference: Motion, applied: Tensor, memory: Tensor
    ) -> Step:
        """Return u ``(*batch, M)``; a reference ``(N,)`` serves the whole batch."""
        integral, last_u, typical, inverse = memory.split(self._sizes, dim=-1)
        error = reference.q - q
        integral = integral + self.period * error * is_applied(last_u, applied)
        position, velocity, rate = self.gains
        feedback = position * error + rate * integral - velocity * v
        matrix = inverse.unflatten(-1, (self.num_inputs, self.num_coordinates))
        u = typical + matvec(matrix, feedback)
        return Step(u, torch.cat([integral, u, typical, inverse], dim=-1))
