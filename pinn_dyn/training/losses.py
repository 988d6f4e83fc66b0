"""Losses of predicted windows."""

from __future__ import annotations

import abc
from collections.abc import Sequence

import torch
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor, nn

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor, Predictor
from pinn_dyn.mechanics.integrators import Sticking
from pinn_dyn.models.statistics import Statistics

__all__ = ["IncrementLoss", "MidpointLoss", "Penalized", "WindowLoss"]


class NonFiniteLossError(RuntimeError):
    """Error: the training loss became NaN or infinite."""


class WindowLoss(nn.Module, abc.ABC):
    """Loss of a model on a batch of windows. The initial value is near one."""

    @abc.abstractmethod
    def forward(self, model: Predictor, windows: Windows) -> Tensor:
        """Return the loss, a scalar, by operations that can be traced."""

    def selected(self, windows: Windows, progress: float) -> Windows:
        """Return the part of the windows that the loss uses at ``progress`` from 0 to 1."""
        return windows

    def evaluations(self, model: ContinuousPredictor, steps: int) -> int:
        """Return the number of evaluations of the state derivative in a window of ``steps`` steps.

        The default is that of a rollout. It is 0 if joints stick, in which case other functions of
        the model are called.
        """
        integrator = model.integrator
        if isinstance(integrator, Sticking):
            return 0
        return steps * integrator.substeps * len(integrator.nodes)


class Penalized(WindowLoss):
    """Sum of a loss and the penalty of the model (:meth:`Predictor.penalty`).

    The penalty is evaluated at the start of each window, with the mean acceleration and the mean
    input of the first step.
    """

    def __init__(self, loss: WindowLoss):
        super().__init__()
        self.loss = loss

    def selected(self, windows: Windows, progress: float) -> Windows:
        return self.loss.selected(windows, progress)

    def evaluations(self, model: ContinuousPredictor, steps: int) -> int:
        return self.loss.evaluations(model, steps)

    def forward(self, model: Predictor, windows: Windows) -> Tensor:
        q, v = windows.start("qv").chunk(2, dim=-1)
        step = (windows.t[1] - windows.t[0]).to(q)
        a = windows.increments("qv")[..., 0, model.num_coordinates :] / step
        mean_input = windows.input.means(windows.t)[0].to(q)
        return self.loss(model, windows) + model.penalty(q, v, a, mean_input)


class IncrementLoss(WindowLoss):
    """Mean squared error of predicted state increments, in units of their standard deviation.

    ::

        loss = mean over windows, steps h and components i of w_i ((dx^_hi - dx_hi) / s_hi)^2

    dx_h is the increment of the state from the start of the window to step h, and s_h its standard
    deviation over the training windows. With one step this is the normalized loss of the paper.

    The weight w of the configuration half is 1, as in the Hamiltonian loss of the paper. It is 0
    for windows of one step if dq/dt = v holds by construction and the rollout starts at the
    measured v, as in the Lagrangian loss of the paper.

    With ``huber`` = d the mean r^2 over the components of each window and step is replaced by::

        2 d^2 (sqrt(1 + r^2 / d^2) - 1)

    It is r^2 for small r and 2 d r for large r, which gives slow motions more weight (pseudo-Huber;
    Charbonnier et al. 1997, "Deterministic edge-preserving regularization in computed imaging").

    A curriculum ``[k_1, ... k_S]`` divides the training into S equal stages. Stage s only uses the
    first k_s steps of a window.

    Args:
        statistics: scales of the data.
        model: the model that will be trained.
        curriculum: steps in each stage, increasing to the H of the windows. The default is H.
        velocity_weight: w of the velocity or momentum half.
        huber: d in units of the spread of the increments. The default is the squared error.

    Raises:
        ValueError: if the curriculum does not increase to H.
    """

    scale: Tensor

    def __init__(
        self,
        statistics: Statistics,
        model: Predictor,
        curriculum: Sequence[PositiveInt] | None = None,
        velocity_weight: PositiveFloat = 1.0,
        huber: PositiveFloat | None = None,
    ):
        super().__init__()
        self.huber = huber
        scale = statistics.increment_std(model.state).float().clone()
        scale[:, model.num_coordinates :] /= velocity_weight**0.5
        self.register_buffer("scale", scale, persistent=False)
        steps = scale.shape[0]
        self.curriculum = [steps] if curriculum is None else list(curriculum)
        if self.curriculum != sorted({k for k in self.curriculum if k >= 1} | {steps}):
            raise ValueError(
                f"curriculum is {curriculum}, expected step counts that increase from at least 1 "
                f"to the {steps} of the windows (data.steps)"
            )
        measured_start = isinstance(model, ContinuousPredictor) and not model.learns_initial_state
        exact_rate = measured_start and model.state == "qv"
        self.exact_coordinates = model.num_coordinates if exact_rate else 0

    def selected(self, windows: Windows, progress: float) -> Windows:
        stages = len(self.curriculum)
        return windows.first(self.curriculum[min(int(progress * stages), stages - 1)])

    def forward(self, model: Predictor, windows: Windows) -> Tensor:
        start = windows.start(model.state, model.history_steps)
        predicted = model.increments(start, windows.t, windows.input)
        return self.error(predicted[..., 1:, :], windows.increments(model.state))

    def error(self, predicted: Tensor, measured: Tensor) -> Tensor:
        """Return the loss of increments ``(B, k, 2N)``."""
        steps = predicted.shape[-2]
        residual = (predicted - measured) / self.scale[:steps]
        residual = residual[..., self.exact_coordinates if steps == 1 else 0 :]
        if self.huber is None:
            return torch.mean(residual**2)
        square = torch.mean(residual**2, dim=-1)
        # 2 d^2 (sqrt(1 + r^2/d^2) - 1), without cancellation for small r.
        return torch.mean(2 * square / (torch.sqrt(1 + square / self.huber**2) + 1))


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

    def evaluations(self, model: ContinuousPredictor, steps: int) -> int:
        return 1

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
