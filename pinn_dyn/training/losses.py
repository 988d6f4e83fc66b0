"""Losses: how far predicted windows are from measured ones."""

from __future__ import annotations

import abc
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import ContinuousPredictor, Predictor
from pinn_dyn.models.statistics import Statistics


class WindowLoss(nn.Module, abc.ABC):
    """A loss of a model on a batch of windows, a number near one before anything is learned."""

    @abc.abstractmethod
    def forward(self, model: Predictor, windows: Windows, progress: float) -> Tensor:
        """The loss, a scalar; ``progress`` is the part of the training that is over, 0 to 1."""

    @abc.abstractmethod
    def compile_dynamics(self, model: Predictor) -> None:
        """From now on train with compiled dynamics of the model."""


class IncrementLoss(WindowLoss):
    """Mean squared error of predicted state increments, each in units of its own spread.

    ::

        loss = mean over windows, steps h and components i of w_i ((dx^_hi - dx_hi) / s_hi)^2

    dx_h is the increment of the state from the window's start to its h-th step and s_h its
    standard deviation over the training windows. With one step this is the paper's loss
    ||x_{k+1} - x^_{k+1}||^2, normalized; with more it is the multi-step loss.

    The weight w of the configuration half is 1, as in the paper's Hamiltonian loss; it is 0 for
    windows of one step where dq/dt = v holds by construction, as in the paper's Lagrangian loss.
    Over several steps it is 1 again: a measured q is better than a velocity derived from it. A
    window costs four evaluations of the dynamics per step.

    A curriculum ``[k_1, ... k_S]`` divides the training into S equal stages; stage s rolls out and
    compares the first k_s steps of a window alone. Short roll-outs first are cheap, and keep a
    model that knows nothing yet from diverging over a long window.

    Args:
        statistics: scales of the data.
        model: the model that will be trained.
        curriculum: steps in each stage, increasing to the H of the windows; H throughout if None.

    Raises:
        ValueError: on a curriculum that does not increase from at least 1 to H.
    """

    scale: Tensor

    def __init__(
        self,
        statistics: Statistics,
        model: Predictor,
        curriculum: Sequence[int] | None = None,
    ):
        super().__init__()
        momentum = model.coordinates == "momentum"
        std = statistics.momentum_increment_std if momentum else statistics.velocity_increment_std
        self.register_buffer("scale", std.float(), persistent=False)
        steps = std.shape[0]
        self.curriculum = [steps] if curriculum is None else list(curriculum)
        # Strictly increasing from at least 1 to the steps of a window.
        if self.curriculum != sorted({k for k in self.curriculum if k >= 1} | {steps}):
            raise ValueError(
                f"curriculum is {curriculum}, expected step counts that increase from at least 1 "
                f"to the {steps} of the windows (data.steps)"
            )
        exact_rate = isinstance(model, ContinuousPredictor) and not momentum
        self.exact_coordinates = model.num_coordinates if exact_rate else 0

    def steps(self, progress: float) -> int:
        """How many steps of a window count when this part of the training is over."""
        stages = len(self.curriculum)
        return self.curriculum[min(int(progress * stages), stages - 1)]

    def forward(self, model: Predictor, windows: Windows, progress: float) -> Tensor:
        windows = windows.first(self.steps(progress))
        predicted = model.increments(
            windows.start(model.coordinates),
            windows.t,
            windows.u,
            t_input=windows.t_input,
            interpolation=windows.interpolation,
        )
        return self.error(predicted[..., 1:, :], windows.increments(model.coordinates))

    def error(self, predicted: Tensor, measured: Tensor) -> Tensor:
        """The loss of increments over the first k steps, ``(B, k, 2N)``."""
        steps = predicted.shape[-2]
        residual = (predicted - measured) / self.scale[:steps]
        return torch.mean(residual[..., self.exact_coordinates if steps == 1 else 0 :] ** 2)

    def compile_dynamics(self, model: Predictor) -> None:
        if isinstance(model, ContinuousPredictor):
            model.compile_derivative()
