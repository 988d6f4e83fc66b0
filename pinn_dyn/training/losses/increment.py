"""Loss on the increments of rollouts."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor, Predictor
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.training.losses.window_loss import WindowLoss


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
        start = windows.start(model.state, model.past_steps)
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
