"""Black boxes: the rivals, which know no mechanics."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pinn_dyn.mechanics import ContinuousPredictor, Interpolation, Predictor
from pinn_dyn.models.initial_velocity import InitialVelocityHead, MeasuredVelocity
from pinn_dyn.models.mlp import MLP
from pinn_dyn.models.scales import Scales
from pinn_dyn.models.statistics import Statistics


class NextStateMLP(Predictor):
    """x_{k+1} = x_k + s * network(x_k, u_k, u_{k+1}), the paper's black box.

    The state is x = (q, v). Inputs are normalized by mean and standard deviation, the output by
    the standard deviation s of the state increment over one step. A step has one length, that of
    the windows it was trained on.

    Args:
        statistics: scales of the data.
        hidden: widths of the hidden layers.
        activation: activation of the hidden layers.
        angles: which coordinates are angles; the network sees their sine and cosine.
    """

    scale: Tensor
    step: Tensor

    def __init__(
        self,
        statistics: Statistics,
        hidden: Sequence[int],
        activation: str = "softplus",
        angles: Sequence[int] = (),
    ):
        size, inputs = statistics.num_coordinates, statistics.num_inputs
        super().__init__(size, inputs, "velocity")
        mean, std = statistics.network_input(repeat_input=2)
        self.network = MLP(2 * size + 2 * inputs, 2 * size, hidden, activation, mean, std, angles)
        self.register_buffer("scale", statistics.velocity_increment_std[0].float())
        self.register_buffer("step", torch.tensor(statistics.step, dtype=torch.float64))

    @property
    def fixed_step(self) -> float:  # type: ignore[override]
        """The step of the windows that it was trained on, s."""
        return float(self.step)

    def increments(
        self,
        x0: Tensor,
        t: Tensor,
        u: Tensor,
        *,
        t_input: Tensor | None = None,
        interpolation: Interpolation = "linear",
    ) -> Tensor:
        """Apply the network step by step.

        Raises:
            ValueError: if ``t`` does not advance by the step the model was trained on, or if its
                times are not among the sample times of the input.
        """
        grid = t if t_input is None else t_input
        step = self.fixed_step
        spacing = (t[1:] - t[:-1]).double()
        if (spacing - step).abs().max() > 1e-3 * step:
            raise ValueError(
                f"NextStateMLP predicts in steps of {step:g} s, as it was trained, but t advances "
                f"by {float(spacing.min()):g} to {float(spacing.max()):g} s: predict with that step"
            )
        index = torch.searchsorted(grid.double(), t.double() - 0.5 * float(grid[1] - grid[0]))
        index = index.clamp(max=grid.shape[0] - 1)
        if (grid[index].double() - t.double()).abs().max() > 1e-3 * step:
            raise ValueError("the times t are not among the sample times t_input of the input")
        samples = u[..., index, :]
        x = torch.zeros_like(x0)
        path = [x]
        for k in range(t.shape[0] - 1):
            after = samples[..., k if interpolation == "hold" else k + 1, :]
            features = torch.cat([x0 + x, samples[..., k, :], after], dim=-1)
            x = x + self.scale * self.network(features)
            path.append(x)
        return torch.stack(path, dim=-2)


class AccelerationMLP(ContinuousPredictor):
    """dv/dt = s * network(q, v, u), integrated by the same RK4 as the structured models.

    A fairer rival than :class:`NextStateMLP`: it knows that v is the rate of q, and it is not
    tied to one step. s is the standard deviation of the velocity increment over a step, divided
    by the step.

    Args:
        statistics: scales of the data.
        hidden: widths of the hidden layers.
        activation: activation of the hidden layers.
        angles: which coordinates are angles; the network sees their sine and cosine.
        substeps: RK4 steps within a step of the data.
        initial_velocity: builder of the head for the velocity at which roll-outs start.
    """

    scale: Tensor

    def __init__(
        self,
        statistics: Statistics,
        hidden: Sequence[int],
        activation: str = "softplus",
        angles: Sequence[int] = (),
        substeps: int = 1,
        initial_velocity: InitialVelocityHead = MeasuredVelocity,
    ):
        size, inputs = statistics.num_coordinates, statistics.num_inputs
        super().__init__(size, inputs, "velocity")
        self.substeps = substeps
        mean, std = statistics.network_input(repeat_input=1)
        self.network = MLP(2 * size + inputs, size, hidden, activation, mean, std, angles)
        acceleration = statistics.velocity_increment_std[0, size:] / statistics.step
        self.register_buffer("scale", acceleration.float())
        self.initial_velocity = initial_velocity(
            Scales(statistics, statistics.v_std, tuple(angles))
        )
        self.learns_initial_state = self.initial_velocity.learned

    def initial_state(self, x0: Tensor, u0: Tensor) -> Tensor:
        """(q, v_0) with the v_0 of its head, ``(*batch, 2N)``."""
        return self.initial_velocity.initial_state(x0, u0)

    def state_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """d(q, v)/dt, ``(*batch, 2N)``."""
        v = x[..., self.num_coordinates :]
        return torch.cat([v, self.scale * self.network(torch.cat([x, u], dim=-1))], dim=-1)
