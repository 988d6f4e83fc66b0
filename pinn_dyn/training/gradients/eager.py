"""Gradients by autograd."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import Predictor
from pinn_dyn.training.losses import WindowLoss

Engine = Callable[[Windows], Tensor]
"""Maps windows to the loss, whose backward pass gives the gradient in the model's parameters."""


class Eager:
    """The loss of a model, operation by operation."""

    def __init__(self, loss: WindowLoss, model: Predictor):
        self.loss = loss
        self.model = model

    def __call__(self, windows: Windows) -> Tensor:
        """The loss; autograd has recorded how it came about."""
        return self.loss(self.model, windows)
