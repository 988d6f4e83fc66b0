"""The prediction contract: what every model, mechanical or black box, can do."""

from __future__ import annotations

import abc
import copy
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar, final

import torch
from torch import Tensor, nn

from pinn_dyn.mechanics.arrays import require_last_dim
from pinn_dyn.mechanics.integration import rollout_increments
from pinn_dyn.mechanics.steps import Integrator, Scheme, rk4, rosenbrock
from pinn_dyn.mechanics.trajectory import Coordinates, Interpolation


class Predictor(nn.Module, abc.ABC):
    """Predicts how a state moves under a given input.

    Attributes:
        num_coordinates: N, the dimension of q.
        num_inputs: M, the dimension of u.
        coordinates: ``"velocity"`` if the state is (q, v), ``"momentum"`` if it is (q, p).
        fixed_step: the one step in s that the model predicts in, or None if it takes any.
    """

    fixed_step: float | None = None

    def __init__(self, num_coordinates: int, num_inputs: int, coordinates: Coordinates):
        super().__init__()
        for name, value in (("num_coordinates", num_coordinates), ("num_inputs", num_inputs)):
            if value < 1:
                raise ValueError(f"{name} is {value}, expected at least 1")
        self.num_coordinates = num_coordinates
        self.num_inputs = num_inputs
        self.coordinates: Coordinates = coordinates

    @abc.abstractmethod
    def increments(
        self,
        x0: Tensor,
        t: Tensor,
        u: Tensor,
        *,
        t_input: Tensor | None = None,
        interpolation: Interpolation = "linear",
    ) -> Tensor:
        """Increments x(t_k) - x(t_0), ``(*batch, T, 2N)``, from ``x0`` ``(*batch, 2N)``.

        ``u`` ``(*batch, K, M)`` is sampled at ``t_input`` ``(K,)``, or at ``t`` if None.
        """

    @final
    def predict(
        self,
        x0: Tensor,
        t: Tensor,
        u: Tensor,
        *,
        t_input: Tensor | None = None,
        interpolation: Interpolation = "linear",
    ) -> Tensor:
        """States x(t_k), ``(*batch, T, 2N)``; arguments as for :meth:`increments`."""
        require_last_dim("x0", x0, 2 * self.num_coordinates, "2N")
        require_last_dim("u", u, self.num_inputs, "M")
        increments = self.increments(x0, t, u, t_input=t_input, interpolation=interpolation)
        return x0.unsqueeze(-2) + increments


class ContinuousPredictor(Predictor):
    """A predictor given by a state derivative dx/dt = f(x, u), integrated by RK4.

    Attributes:
        integrator: ``"rk4"``, or ``"rosenbrock"`` for motions so damped that RK4 would need many
            substeps (:func:`pinn_dyn.mechanics.steps.rosenbrock`).
        substeps: steps of the integrator within a step of the data. One is enough while the data
            resolve the fastest motion; data of a low rate need more.
        learns_initial_state: whether roll-outs start at another state than the measured one
            (:meth:`initial_state`).
        compiled_rollouts: take the steps of roll-outs without gradients by a compiled loop; pays
            for long ones, as compiling takes half a minute to a minute.
    """

    integrator: Integrator = "rk4"
    substeps: int = 1
    learns_initial_state: bool = False
    compiled_rollouts: bool = False
    _compiled: Callable[..., Tensor] | None = None

    @abc.abstractmethod
    def state_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """dx/dt, ``(*batch, 2N)``, of the state x ``(*batch, 2N)`` under u ``(*batch, M)``."""

    def implicit_solver(self, x: Tensor, step: Tensor) -> Callable[[Tensor], Tensor]:
        """Maps r to the k with (1 - s J) k = r, both ``(*batch, 2N)``.

        s is the ``step``, and J what is stiff of df/dx at x. Here J = 0: nothing is.
        """
        return lambda rate: rate

    def initial_state(self, x0: Tensor, u0: Tensor) -> Tensor:
        """The state ``(*batch, 2N)`` at which a roll-out from the measured x0 starts, under u0.

        Here it is x0 itself.
        """
        return x0

    def compile_derivative(self) -> None:
        """Use a compiled state derivative while the model is in training mode.

        Only the derivative is compiled, or a step of the Rosenbrock method, not the unrolled
        integrator: that keeps compilation short. Validation and test run eagerly, as their batch
        shapes vary.
        """
        compiled = self.state_derivative if self.integrator == "rk4" else self.scheme().step
        self._compiled = torch.compile(compiled)

    def scheme(self) -> Scheme:
        """The method of integration, with this system in it."""
        if self.integrator == "rk4":
            return rk4(self.state_derivative)
        return rosenbrock(self.state_derivative, self.implicit_solver)

    def integration_step(
        self, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        """One step of the method of integration; arguments as of :attr:`Scheme.step`."""
        return self.scheme().step(increment, start, inputs, h)

    def __getstate__(self) -> dict[str, object]:
        # A compiled function belongs to this object: copies and pickles go without it.
        return {**self.__dict__, "_compiled": None}

    @final
    def increments(
        self,
        x0: Tensor,
        t: Tensor,
        u: Tensor,
        *,
        t_input: Tensor | None = None,
        interpolation: Interpolation = "linear",
    ) -> Tensor:
        """Integrate the state derivative, ``substeps`` steps per interval of ``t``.

        Increments count from the measured ``x0``, wherever the roll-out starts.
        """
        derivative, scheme = self.state_derivative, None
        compiled = self._compiled if self.training else None
        if self.integrator == "rk4":
            derivative = compiled or derivative
        else:
            scheme = self.scheme()
            scheme = replace(scheme, step=compiled or scheme.step)
        start = self.initial_state(x0, u[..., 0, :]) if self.learns_initial_state else x0
        increments = rollout_increments(
            derivative,
            start,
            t,
            u,
            t_input=t_input,
            interpolation=interpolation,
            substeps=self.substeps,
            scheme=scheme,
            compile=self.compiled_rollouts and not torch.is_grad_enabled(),
        )
        if not self.learns_initial_state:
            return increments
        moved = increments[..., 1:, :] + (start - x0).unsqueeze(-2)
        return torch.cat([increments[..., :1, :], moved], dim=-2)


_Model = TypeVar("_Model", bound=Predictor)


def double_copy(model: _Model, device: torch.device | str = "cpu") -> _Model:
    """A copy of the model in float64 and evaluation mode; the model itself stays as it is."""
    return copy.deepcopy(model).to(device=device, dtype=torch.float64).eval()
