"""Black-box models, the baselines without mechanics."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from pydantic import NonNegativeInt, PositiveInt
from torch import Tensor

from pinn_dyn.mechanics import RK4, ContinuousPredictor, Integrator, Predictor, Signal
from pinn_dyn.models.initial_velocity import InitialVelocityHead, start_of
from pinn_dyn.models.mlp import MLP, Activation
from pinn_dyn.models.scales import Scales
from pinn_dyn.models.statistics import Statistics


class NextStateMLP(Predictor):
    """x_{k+1} = x_k + s * network(x_k, u_k, u_{k+1}), the black box of the paper.

    The state is x = (q, v). s is the standard deviation of the increment of x over a step. The step
    is that of the training windows.

    Args:
        statistics: scales of the data.
        hidden, activation: widths and activation of the hidden layers.
        angles: coordinates that are angles. The network uses their sine and cosine.
    """

    scale: Tensor
    step: Tensor

    def __init__(
        self,
        statistics: Statistics,
        hidden: Sequence[PositiveInt] = (128, 128, 128, 128, 128),
        activation: Activation = "softplus",
        angles: Sequence[NonNegativeInt] = (),
    ):
        size, inputs = statistics.num_coordinates, statistics.num_inputs
        super().__init__(size, inputs)
        mean, std = statistics.network_input(repeat_input=2)
        self.network = MLP(2 * size + 2 * inputs, 2 * size, hidden, activation, mean, std, angles)
        self.register_buffer("scale", statistics.qv_increment_std[0].float())
        self.register_buffer("step", torch.tensor(statistics.step, dtype=torch.float64))

    @property
    def fixed_step(self) -> float:  # type: ignore[override]
        """Step of the training windows, s."""
        return float(self.step)

    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """Apply the network step by step. The spacing of ``t`` must be the step."""
        self._require_step(t)
        x = torch.zeros_like(x0)
        path = [x]
        # A held input has the same value at both ends of a step.
        for before, after in input.stages(t, (0.0, 1.0)).to(x0):
            x = x + self.increment(x0 + x, before, after)
            path.append(x)
        return torch.stack(path, dim=-2)

    def increment(self, x: Tensor, u: Tensor, u_next: Tensor) -> Tensor:
        """Return the increment of x over a step with input u at its start and u_next at its end."""
        return self.scale * self.network(torch.cat([x, u, u_next], dim=-1))


class AccelerationMLP(ContinuousPredictor):
    """dv/dt = s * network(q, v, u), integrated like the structured models.

    dq/dt = v holds by construction, and predictions may have any step. s is the standard deviation
    of the velocity increment over a step, divided by the step.

    Args:
        statistics: scales of the data.
        hidden, activation: widths and activation of the hidden layers.
        angles: coordinates that are angles. The network uses their sine and cosine.
        integrator: the integration method.
        initial_velocity: builder of the head for the initial velocity.
    """

    scale: Tensor

    def __init__(
        self,
        statistics: Statistics,
        hidden: Sequence[PositiveInt] = (128, 128, 128),
        activation: Activation = "softplus",
        angles: Sequence[NonNegativeInt] = (),
        integrator: Integrator | None = None,
        initial_velocity: InitialVelocityHead | None = None,
    ):
        size, inputs = statistics.num_coordinates, statistics.num_inputs
        super().__init__(size, inputs)
        self.integrator = integrator or RK4()
        mean, std = statistics.network_input(repeat_input=1)
        self.network = MLP(2 * size + inputs, size, hidden, activation, mean, std, angles)
        self.register_buffer("scale", statistics.acceleration.float())
        scales = Scales(statistics, statistics.v_std, tuple(angles))
        self.initial_velocity = initial_velocity and initial_velocity(scales)
        self.learns_initial_state = initial_velocity is not None

    def initial_state(self, x0: Tensor, u0: Tensor) -> Tensor:
        return start_of(self.initial_velocity, x0, u0)

    def state_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        v = x[..., self.num_coordinates :]
        return torch.cat([v, self.scale * self.network(torch.cat([x, u], dim=-1))], dim=-1)
