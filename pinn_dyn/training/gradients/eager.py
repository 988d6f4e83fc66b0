"""Gradients by autograd."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import Predictor
from pinn_dyn.training.losses import WindowLoss
from pinn_dyn.training.parameter_vector import ParameterVector

Engine = Callable[[Windows], tuple[Tensor, Tensor]]
"""Function from windows to the loss ``()`` and its gradient ``(P,)``."""


class Eager:
    """Engine for loss and gradient by eager autograd."""

    def __init__(self, loss: WindowLoss, model: Predictor, vector: ParameterVector):
        self.loss, self.model, self.vector = loss, model, vector

    def __call__(self, windows: Windows) -> tuple[Tensor, Tensor]:
        loss = self.loss(self.model, windows)
        return loss.detach(), self.vector.gradient_of(loss)
