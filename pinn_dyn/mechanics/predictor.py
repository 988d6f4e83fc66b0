"""The prediction contract: what every model, mechanical or black box, can do."""

from __future__ import annotations

import abc
import copy
from collections.abc import Callable
from typing import TypeVar, final

import torch
from pydantic import PositiveInt
from torch import Tensor, nn

from pinn_dyn.mechanics.arrays import require_last_dim
from pinn_dyn.mechanics.integrators import RK4, Integrator
from pinn_dyn.mechanics.rollout import path_between, require_start
from pinn_dyn.mechanics.signal import Signal
from pinn_dyn.mechanics.trajectory import State, Trajectory


class Predictor(nn.Module, abc.ABC):
    """Predicts how a state moves under a given input.

    Attributes:
        num_coordinates: N, the dimension of q.
        num_inputs: M, the dimension of u.
        state: what the state x ``(*batch, 2N)`` is that it starts from and predicts: ``"qv"`` for
            (q, v), ``"qp"`` for (q, p).
        fixed_step: the one step in s that the model predicts in, or None if it takes any.
        penalized: whether its freedom costs something in a training, see :meth:`penalty`.
        input_history: how long before the start the model may look at the input, s.
    """

    fixed_step: float | None = None
    penalized: bool = False
    input_history: float = 0.0

    def __init__(self, num_coordinates: PositiveInt, num_inputs: PositiveInt, state: State = "qv"):
        super().__init__()
        self.num_coordinates = num_coordinates
        self.num_inputs = num_inputs
        self.state: State = state

    @abc.abstractmethod
    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """Increments x(t_k) - x(t_0), ``(*batch, T, 2N)``, from x0 ``(*batch, 2N)``, unchecked.

        ``t`` ``(T,)`` are the times of the solution, s; ``input`` is u, of the same batch.
        """

    def penalty(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """A scalar that training adds to the error of prediction, where ``penalized``.

        q, v and a ``(B, N)`` and u ``(B, M)`` are states, accelerations and inputs of the data.
        """
        return q.new_zeros(())

    def acting_input(self, input: Signal) -> Signal:
        """The input as it acts on the robot; here as it is, in a model of a delay later."""
        return input

    @final
    def acting_samples(self, truth: Trajectory) -> Tensor:
        """The input as it acts at the samples of a trajectory, ``(*batch, T, M)``."""
        if not self.input_history:
            return truth.u
        input = self.acting_input(truth.input_since(self.input_history))
        return input.at(truth.t).movedim(0, -2)

    def learned_figures(self) -> dict[str, float]:
        """Learned numbers to be reported by their names, such as an input delay in s."""
        return {}

    @final
    def predict(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """States x(t_k), ``(*batch, T, 2N)``; arguments as for :meth:`increments`.

        Raises:
            ValueError: on a start or an input of the wrong size, times that do not increase, or a
                start that is not finite.
        """
        require_last_dim("x0", x0, 2 * self.num_coordinates, "2N")
        require_last_dim("u", input.u, self.num_inputs, "M")
        require_start(x0, t, input)
        return x0.unsqueeze(-2) + self.increments(x0, t, input)


class ContinuousPredictor(Predictor):
    """A predictor given by a state derivative dx/dt = f(x, u), and integrated.

    The state that is integrated, ``(*batch, S)``, begins with the 2N numbers of (q, v) or (q, p).
    A model of more, such as the states of actuators, gives the others in :meth:`initial_state`;
    they stay inside a roll-out.

    Attributes:
        integrator: the method, and its steps in a step of the data.
        learns_initial_state: whether roll-outs start at another state than the measured one.
    """

    integrator: Integrator = RK4()
    learns_initial_state: bool = False

    @abc.abstractmethod
    def state_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """dx/dt, ``(*batch, S)``, of the state x ``(*batch, S)`` under u ``(*batch, M)``."""

    def implicit_solver(self, x: Tensor, step: Tensor) -> Callable[[Tensor], Tensor]:
        """Maps r to the k with (1 - s J) k = r, both ``(*batch, S)``.

        s is the ``step``, and J what is stiff of df/dx at x. Here J = 0: nothing is.
        """
        return lambda rate: rate

    def initial_state(self, x0: Tensor, u0: Tensor) -> Tensor:
        """Where a roll-out from the measured x0 starts, ``(*batch, S)``, under u0 ``(*batch, M)``.

        Here it is x0 itself.
        """
        return x0

    def integration_step(
        self, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        """One step of the integrator; arguments as of :meth:`Integrator.step`."""
        return self.integrator.step(self, increment, start, inputs, h)

    @final
    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """Integrate the state derivative.

        Increments count from the measured ``x0``, wherever the roll-out starts.
        """
        input = self.acting_input(input)
        first = input.u[..., 0, :]
        if self.input_history:  # the signal begins before the start
            (first,) = input.at(t[:1]).to(x0)
        start = self.initial_state(x0, first)
        increments = path_between(self, self.integrator, start, t, input)
        if start is x0:
            return increments
        size = x0.shape[-1]
        moved = increments[..., 1:, :size] + (start[..., :size] - x0).unsqueeze(-2)
        return torch.cat([increments[..., :1, :size], moved], dim=-2)


_Model = TypeVar("_Model", bound=Predictor)


def double_copy(model: _Model, device: torch.device | str = "cpu") -> _Model:
    """A copy of the model in float64 and evaluation mode; the model itself stays as it is."""
    return copy.deepcopy(model).to(device=device, dtype=torch.float64).eval()
