"""The prediction contract of every model, mechanical or black box."""

from __future__ import annotations

import abc
import copy
from collections.abc import Callable, Sequence
from typing import TypeVar, final

import torch
from numpy.typing import ArrayLike
from pydantic import NonNegativeInt, PositiveInt
from torch import Tensor, nn

from pinn_dyn.mechanics.arrays import jacobians, require_last_dim
from pinn_dyn.mechanics.integrators import RK4, Integrator
from pinn_dyn.mechanics.rollout import path_between, require_start
from pinn_dyn.mechanics.signal import Signal
from pinn_dyn.mechanics.trajectory import State


class Predictor(nn.Module, abc.ABC):
    """Model that predicts the motion of a state under an input.

    Attributes:
        num_coordinates, num_inputs: N and M, the dimensions of q and u.
        state: the predicted state x ``(*batch, 2N)``: ``"qv"`` for (q, v), ``"qp"`` for (q, p).
        fixed_step: step of a discrete-time model in s, or None if any step is possible.
        penalized: true if training adds :meth:`penalty` to the loss.
        input_history: time before the start in which the model uses the input, s.
        history_steps: number n of earlier q that the model uses, one step apart, the latest first.
            They follow the state in x0 ``(*batch, 2N + nN)``. If x0 ends with the state, the robot
            is assumed to have been at rest.
        labels, input_labels: name and unit of each coordinate and input, for files, if known.
        dead_time: delay of the robot's inputs for control laws, one number or M, s.
    """

    fixed_step: float | None = None
    penalized: bool = False
    input_history: float = 0.0
    history_steps: int = 0
    labels: Sequence[str] = ()
    input_labels: Sequence[str] = ()
    dead_time: ArrayLike = 0.0

    def __init__(
        self, num_coordinates: PositiveInt, num_inputs: NonNegativeInt, state: State = "qv"
    ):
        super().__init__()
        self.num_coordinates = num_coordinates
        self.num_inputs = num_inputs
        self.state: State = state

    @abc.abstractmethod
    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """Return increments x(t_k) - x(t_0), ``(*batch, T, 2N)``, without checks.

        x0 is ``(*batch, 2N)``, t ``(T,)`` are times in s, and ``input`` is u of the same batch.
        """

    @property
    def members(self) -> list[Predictor]:
        """Members of an ensemble. A single model is its only member."""
        return [self]

    def member_increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """Return :meth:`increments` of each of E members, ``(E, *batch, T, 2N)``."""
        return self.increments(x0, t, input).unsqueeze(0)

    def penalty(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """Return a scalar that training adds to the loss, at data q, v, a and u ``(B, N or M)``."""
        return q.new_zeros(())

    @final
    def predict(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """Return states x(t_k), ``(*batch, T, 2N)``. The arguments are those of :meth:`increments`.

        Raises:
            ValueError: if a size is wrong, times do not increase, or the state is not finite.
        """
        size = 2 * self.num_coordinates
        past = self.history_steps * self.num_coordinates if x0.shape[-1] > size else 0
        require_last_dim("x0", x0, size + past, "2N")
        require_last_dim("u", input.u, self.num_inputs, "M")
        require_start(x0, t, input)
        return x0[..., None, :size] + self.increments(x0, t, input)

    def _require_step(self, t: Tensor) -> None:
        step, spacing = self.fixed_step or 0.0, t.double().diff()
        if float((spacing - step).abs().max()) > 1e-3 * step:
            raise ValueError(
                f"{type(self).__name__} predicts in steps of {step:g} s, but t advances by "
                f"{float(spacing.min()):g} to {float(spacing.max()):g} s: predict with that step"
            )


class ContinuousPredictor(Predictor):
    """Predictor that integrates a state derivative dx/dt = f(x, u).

    The integrated state ``(*batch, S)`` begins with (q, v) or (q, p). :meth:`initial_state` adds
    more states. ``learns_initial_state`` is true if rollouts start at a learned state.
    """

    integrator: Integrator = RK4()
    learns_initial_state: bool = False

    @abc.abstractmethod
    def state_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """Return dx/dt, ``(*batch, S)``, of the state x ``(*batch, S)`` under u ``(*batch, M)``."""

    def velocity_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """Return d(q, v)/dt, ``(*batch, 2N)``, at x = (q, v), also for models with state (q, p)."""
        return self.state_derivative(x, u)

    @final
    def linearize(
        self, q: Tensor, v: Tensor, u: Tensor, *, sample_time: float | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return A ``(*batch, 2N, 2N)`` and B ``(*batch, 2N, M)`` of the state x = (q, v)::

            dx/dt = f(x, u),    A = df/dx,    B = df/du
            [[A_d, B_d], [0, 1]] = expm(T [[A, B], [0, 0]])      with a sample time T: x_k+1, held u

        A and B describe deviations from an equilibrium (f = 0) or from a motion. The state is
        (q, v), m or rad and m/s or rad/s, also for models that integrate (q, p). Inputs are
        those of the drives; q of elastic joints includes their motors. Dry friction enters by its
        slope at v, which is largest at v = 0.

        Args:
            q, v: ``(*batch, N)``.
            u: ``(*batch, M)``.
            sample_time: T, s; None returns the continuous pair.

        Raises:
            ValueError: if a shape is wrong.
        """
        require_last_dim("q", q, self.num_coordinates, "N")
        require_last_dim("v", v, self.num_coordinates, "N")
        require_last_dim("u", u, self.num_inputs, "M")
        batch = torch.broadcast_shapes(q.shape[:-1], v.shape[:-1], u.shape[:-1])
        q, v, u = (value.expand(*batch, -1) for value in (q, v, u))
        _, (A, B) = jacobians(self.velocity_derivative, torch.cat([q, v], dim=-1), u)
        if sample_time is None:
            return A, B
        size = A.shape[-1]
        block = torch.nn.functional.pad(torch.cat([A, B], dim=-1), (0, 0, 0, B.shape[-1]))
        held = torch.linalg.matrix_exp(sample_time * block)[..., :size, :]
        return held[..., :size], held[..., size:]

    def implicit_solver(self, x: Tensor, step: Tensor) -> Callable[[Tensor], Tensor]:
        """Return a function from r to k with (1 - s J) k = r. The stiff part J of df/dx is zero."""
        return lambda rate: rate

    def initial_state(self, x0: Tensor, u0: Tensor) -> Tensor:
        """Return the initial state ``(*batch, S)`` of a rollout from measured x0 and input u0."""
        return x0

    def integration_step(
        self, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        """Take a step of the integrator, see :meth:`Integrator.step`."""
        return self.integrator.step(self, increment, start, inputs, h)

    @final
    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """Integrate the state derivative. Increments are relative to the measured ``x0``."""
        start = self.initial_state(x0, input.u[..., 0, :])
        increments = path_between(self, self.integrator, start, t, input)
        if start is x0:
            return increments
        size = x0.shape[-1]
        moved = increments[..., 1:, :size] + (start[..., :size] - x0).unsqueeze(-2)
        return torch.cat([increments[..., :1, :size], moved], dim=-2)


_Model = TypeVar("_Model", bound=Predictor)


def double_copy(model: _Model, device: torch.device | str = "cpu") -> _Model:
    """Return a copy of the model in float64 and evaluation mode."""
    return copy.deepcopy(model).to(device=device, dtype=torch.float64).eval()
