"""Loss on the equation of motion at the midpoint of a short step."""

from __future__ import annotations

import torch
from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor, Predictor
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.training.losses.window_loss import WindowLoss


class MidpointLoss(WindowLoss):
    """Mean squared error of the state increment over one step by the midpoint rule.

    A step of length h leads from the measured (q_0, v_0) to the measured (q_1, v_1). Hermite
    interpolation gives the midpoint::

        q_m = (q_0 + q_1)/2 - h dv/8        dq = q_1 - q_0
        v_m = 3 dq/(2 h) - (v_0 + v_1)/4    dv = v_1 - v_0

    The dynamics dv/dt = a(q, v, u) are evaluated there::

        dv^ = h a(q_m, v_m, mean of u over the step)
        loss = mean over windows and components i of ((dv^_i - dv_i) / s_i)^2

    s is the standard deviation of dv over the training windows. For a state (q, p) the midpoint is
    the mean of both ends, and the increments of q and p are compared. The mean of u is exact for
    held and linear inputs.

    The error of the rule is h^2/24 times the second derivative of a along the motion (h^2/12 with
    momenta): 1 % of a for an oscillation of r rad/s with r h = 0.5. A window costs one evaluation
    of the dynamics instead of four by RK4.

    Assumption: q and v have little noise. For noisy logs use longer windows and the increment loss.

    Source: direct collocation (Betts 2010, "Practical Methods for Optimal Control and Estimation
    Using Nonlinear Programming"). This loss is not in the paper.

    Args:
        statistics: scales of the data.
        model: the model that will be trained.

    Raises:
        TypeError: if the model has no state derivative.
        ValueError: if the windows have more than one step, or the model learns its initial state.
    """

    scale: Tensor

    def __init__(self, statistics: Statistics, model: Predictor):
        super().__init__()
        if not isinstance(model, ContinuousPredictor):
            raise TypeError(
                f"model is a {type(model).__name__}, expected one with a state derivative: use "
                "loss=increment"
            )
        if model.learns_initial_state:
            raise ValueError(
                "this loss has no rollout whose initial velocity could be learned: use "
                "loss=increment, or ~model/initial_velocity"
            )
        scale = statistics.increment_std(model.state)
        if scale.shape[0] != 1:
            raise ValueError(
                f"the windows have {scale.shape[0]} steps, expected one: set data.steps=1"
            )
        # For (q, v) the first half holds by construction.
        self.compared = slice(model.num_coordinates if model.state == "qv" else 0, None)
        self.register_buffer("scale", scale[0, self.compared].float(), persistent=False)

    def forward(self, model: Predictor, windows: Windows) -> Tensor:
        assert isinstance(model, ContinuousPredictor)
        x0, dx = windows.start(model.state), windows.increments(model.state).squeeze(-2)
        h = (windows.t[1] - windows.t[0]).to(x0)
        middle = midpoint(h, x0, dx) if model.state == "qv" else x0 + 0.5 * dx
        (mean_input,) = windows.input.means(windows.t).to(x0)
        residual = h * model.state_derivative(middle, mean_input) - dx
        return torch.mean((residual[..., self.compared] / self.scale) ** 2)


def midpoint(h: Tensor, x0: Tensor, increment: Tensor) -> Tensor:
    """Return the midpoint of a cubic from x0 = (q, v) to x0 + increment over a step of h s."""
    (q, v), (dq, dv) = x0.chunk(2, -1), increment.chunk(2, -1)
    return torch.cat([q + 0.5 * dq - h * dv / 8, 1.5 * dq / h - 0.5 * v - 0.25 * dv], dim=-1)
