"""Model predictive control by a model in latent coordinates."""

from __future__ import annotations

from typing import Annotated, cast

import numpy as np
import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor

from pinn_dyn.control.contracts import Controller, Motion
from pinn_dyn.control.effects import Actuator
from pinn_dyn.control.latent_law import LatentLaw
from pinn_dyn.control.predictive import PredictiveControl, Weight
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.models import CoupledOscillators

_ALL = 1e-2  # weight of all z and z', relative


class LatentMechanics:
    """Oscillators as the system of a plan, with coordinates z and velocities dz/dt in 1/s::

        d^2z/dt^2 = (f(u, 0) - K z - T D dz/dt - W^T tanh(W z + b)) / T^2

    Symbols: those of :class:`CoupledOscillators`; step T of the training windows, s.
    """

    input_affine = False

    def __init__(self, model: CoupledOscillators):
        self.num_coordinates, self.num_inputs = len(model.bias), model.num_inputs
        self.model = model

    def largest_input(self) -> Tensor | None:
        """Return None: drives have no limits of their own."""
        return None

    def forward_dynamics(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return d^2z/dt^2 at z, dz/dt and u, ``(*batch, n)``."""
        (K, D), step = self.model.matrices(), self.model.fixed_step
        force = self.model.latent_force(u) - self.model.coupling_force(q)
        return (force - q @ K - step * v @ D) / step**2


class _Planner(PredictiveControl):
    """Plans with a known input u_ref of the goal ``(K, M)``, and weights of q."""

    model: LatentMechanics  # type: ignore[assignment]
    u_ref: np.ndarray

    def _state_weight(self, position: Weight, velocity: Weight) -> np.ndarray:
        model, N, M = self.model.model, self.model.model.num_coordinates, self.num_inputs
        output = model.linearize(model.mean[-M:]).output.chunk(2, dim=-1)
        of_z, of_rate = ((x / model.std[:N, None]).numpy() for x in output)
        step, n = model.fixed_step, self.num_coordinates
        rows = [
            np.sqrt(position) * np.hstack([of_z, step * of_rate]),
            np.sqrt(velocity) * np.hstack([0 * of_z, step * of_z]),
            _ALL * np.diag([1.0] * n + [step] * n),
        ]
        return np.vstack(rows)

    def _start(self, t: float, states: np.ndarray) -> None:
        super()._start(t, states)
        start = zip(self._memory, self.u_ref, strict=True)
        self._memory = [memory._replace(u=u) for memory, u in start]

    def _feedforward(self, q: Tensor, v: Tensor, a: Tensor) -> np.ndarray:
        return np.repeat(self.u_ref[:, None], q.shape[-2], axis=1)


class LatentPlan(Controller):
    """:class:`PredictiveControl` in the latent coordinates of :class:`CoupledOscillators`::

        state (z, dz/dt), goal z_d, u_ref = u_d

    z, u_d and z_d are those of a :class:`LatentLaw`, with its observer and its integral action, so
    that the loop has no steady-state error if it comes to rest. A dead time is predicted. The goal
    is constant over the horizon. Needs CasADi (``pip install 'pinn_dyn[mpc]'``).

    Args:
        model: the model, in float64.
        horizon: length of a plan, s.
        step: step of a plan, s; None for that of the training windows.
        position_weight, velocity_weight: weights of q and of its change in a step of the model, in
            standard deviations of q. The output is linearized at the mean input.
        input_weight, rate_weight: weights of u - u_d and of its change in a step of the plan.
        terminal_weight: weight of the last state, in multiples of the others.
        iterations: quadratic programs per instant, see :class:`PredictiveControl`.
        integral_gain, dead_time, noise, first_input: see :class:`LatentLaw`.
        actuator: hard limits of the input and of its rate.
    """

    def __init__(
        self,
        model: CoupledOscillators,
        horizon: PositiveFloat = 0.2,
        step: PositiveFloat | None = None,
        *,
        position_weight: NonNegativeFloat = 1.0,
        velocity_weight: NonNegativeFloat = 1.0,
        input_weight: PositiveFloat = 0.1,
        rate_weight: NonNegativeFloat = 0.1,
        terminal_weight: NonNegativeFloat = 1.0,
        iterations: PositiveInt = 1,
        integral_gain: PositiveFloat = 10.0,
        dead_time: NonNegativeFloat = 0.0,
        noise: Annotated[float, Field(gt=0)] = 0.01,
        first_input: float | list[float] = 0.0,
        actuator: Actuator | None = None,
    ):
        super().__init__(model.num_coordinates, model.num_inputs)
        self.law = LatentLaw(
            *(model, 0.0, 0.0, integral_gain),
            dead_time=dead_time,
            noise=noise,
            first_input=first_input,
            actuator=actuator,
        )
        self.model, step = model, step or model.fixed_step
        self.planner = _Planner(
            cast(MechanicalSystem, LatentMechanics(model)),  # as far as a plan uses it
            horizon,
            step,
            position_weight=position_weight,
            velocity_weight=velocity_weight,
            input_weight=input_weight,
            rate_weight=rate_weight * step**2,
            terminal_weight=terminal_weight,
            actuator=actuator,
            iterations=iterations,
        )

    def reset(self) -> None:
        self.law.reset()
        self.planner.reset()

    def __call__(self, t: float, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        """Return u ``(*batch, M)``; a reference ``(N,)`` serves the whole batch."""
        self.law(t, q, v, reference)
        x, u_d, z_d = self.law.goal()
        z, rate = x.chunk(2, dim=-1)
        self.planner.u_ref = u_d.reshape(-1, self.num_inputs).numpy()
        goal = Motion(z_d.reshape(-1, z.shape[-1]), *[torch.zeros_like(z_d[0])] * 2)
        u = self.planner(t, z, rate / self.model.fixed_step, goal)
        self.law.replace_input(u)
        return u

    def diagnostics(self) -> dict[str, Tensor]:
        """Return those of :class:`PredictiveControl` and of :class:`LatentLaw`."""
        return {**self.law.diagnostics(), **self.planner.diagnostics()}

    def faults(self) -> dict[str, Tensor]:
        return self.planner.faults()
