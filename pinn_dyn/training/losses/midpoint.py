"""The equation of motion in the middle of a short step as a loss."""

from __future__ import annotations

import torch
from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor, Predictor
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.training.losses.window_loss import WindowLoss


class MidpointLoss(WindowLoss):
    """Mean squared error of the increment of the state in one step, by the midpoint rule.

    A step of length h leads from measured (q_0, v_0) to measured (q_1, v_1). The cubic through
    both, with those slopes (Hermite interpolation), gives its middle::

        q_m = (q_0 + q_1)/2 - h dv/8        dq = q_1 - q_0
        v_m = 3 dq/(2 h) - (v_0 + v_1)/4    dv = v_1 - v_0

    and there the dynamics dv/dt = a(q, v, u) are evaluated once::

        dv^ = h a(q_m, v_m, mean of u over the step)
        loss = mean over windows and components i of ((dv^_i - dv_i) / s_i)^2

    s is the standard deviation of dv over the training windows. Where the state is (q, p) its
    middle is the mean of both ends, and the increments of q and of p are compared. The mean of u
    is exact for inputs that are linear between samples, or held.

    The error of the rule is h^2/24 of the second derivative of a along the motion (h^2/12 with
    momenta): a hundredth of a for an oscillation of r rad/s with r h = 0.5, and 1/2400 with
    r h = 0.1. The terms learn it with the motion: halve ``data.stride`` to see whether it matters.

    One evaluation of the dynamics per window, where the roll-out of one step by RK4 costs four; no
    roll-out and no stiffness, so ``integrator`` is for validation and test alone.

    Assumptions: q and v are measured or simulated with little noise. Noise in v is divided by a
    short h, as in a loss on accelerations by finite differences; for noisy logs take longer
    windows and the increment loss.

    Source: not in the paper, whose losses roll out. Midpoint quadrature of the equation of motion
    along a Hermite interpolant, as in direct collocation (Betts 2010, "Practical Methods for
    Optimal Control and Estimation Using Nonlinear Programming").

    Args:
        statistics: scales of the data.
        model: the model that will be trained.

    Raises:
        TypeError: if the model has no state derivative, as ``model=mlp``.
        ValueError: if the windows have more than one step, or the model learns its initial state.
    """

    scale: Tensor

    def __init__(self, statistics: Statistics, model: Predictor):
        super().__init__()
        if not isinstance(model, ContinuousPredictor):
            raise TypeError(
                f"model is a {type(model).__name__}, expected one with a state derivative, such as "
                "model=lnn or model=acceleration: take loss=increment"
            )
        if model.learns_initial_state:
            raise ValueError(
                "the model learns the velocity at which roll-outs start, and this loss rolls "
                "nothing out: take loss=increment, or ~model/initial_velocity"
            )
        scale = statistics.increment_std(model.state)
        if scale.shape[0] != 1:
            raise ValueError(
                f"the windows have {scale.shape[0]} steps, expected one: set data.steps=1"
            )
        # Of (q, v) the first half holds by construction.
        self.compared = slice(model.num_coordinates if model.state == "qv" else 0, None)
        self.register_buffer("scale", scale[0, self.compared].float(), persistent=False)

    def forward(self, model: Predictor, windows: Windows) -> Tensor:
        assert isinstance(model, ContinuousPredictor)
        x0, dx = windows.start(model.state), windows.increments(model.state).squeeze(-2)
        h = (windows.t[1] - windows.t[0]).to(x0)
        middle = midpoint(h, x0, dx) if model.state == "qv" else x0 + 0.5 * dx
        (mean_input,) = model.acting_input(windows.input).means(windows.t).to(x0)
        residual = h * model.state_derivative(middle, mean_input) - dx
        return torch.mean((residual[..., self.compared] / self.scale) ** 2, dim=(-2, -1))


def midpoint(h: Tensor, x0: Tensor, increment: Tensor) -> Tensor:
    """The state in the middle of a cubic from x0 to x0 + increment, ``(*batch, 2N)``.

    Args:
        h: length of the step, s.
        x0: (q, v) at its start, ``(*batch, 2N)``.
        increment: of (q, v) over the step, ``(*batch, 2N)``.
    """
    (q, v), (dq, dv) = x0.chunk(2, -1), increment.chunk(2, -1)
    return torch.cat([q + 0.5 * dq - h * dv / 8, 1.5 * dq / h - 0.5 * v - 0.25 * dv], dim=-1)
