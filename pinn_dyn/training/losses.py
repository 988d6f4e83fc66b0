"""Losses: how far predicted windows are from measured ones."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pinn_dyn.mechanics import ContinuousPredictor, Predictor
from pinn_dyn.models.statistics import Statistics


class IncrementLoss(nn.Module):
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

    Args:
        statistics: scales of the data.
        model: the model that will be trained.
    """

    scale: Tensor

    def __init__(self, statistics: Statistics, model: Predictor):
        super().__init__()
        momentum = model.coordinates == "momentum"
        std = statistics.momentum_increment_std if momentum else statistics.velocity_increment_std
        self.register_buffer("scale", std.float(), persistent=False)
        exact_rate = isinstance(model, ContinuousPredictor) and not momentum and std.shape[0] == 1
        self.first = model.num_coordinates if exact_rate else 0

    def forward(self, predicted: Tensor, measured: Tensor) -> Tensor:
        """The loss of increments ``(B, H, 2N)``."""
        residual = (predicted - measured) / self.scale
        return torch.mean(residual[..., self.first :] ** 2)
