"""Gradients by autograd."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import Predictor
from pinn_dyn.training.losses import WindowLoss
from pinn_dyn.training.parameter_vector import ParameterVector

Engine = Callable[[Windows], tuple[Tensor, Tensor]]
"""Maps windows to the loss and its gradient in the parameters, ``()`` and ``(P,)``, or to those of
the members of an ensemble, ``(E,)`` and ``(E, P)``."""


class Eager:
    """Loss and gradient of a model, operation by operation.

    Args:
        loss: of the model.
        model: what is trained.
        vector: its parameters.
    """

    def __init__(self, loss: WindowLoss, model: Predictor, vector: ParameterVector):
        self.loss = loss
        self.model = model
        self.vector = vector

    def __call__(self, windows: Windows) -> tuple[Tensor, Tensor]:
        losses = self.loss(self.model, windows)
        return losses.detach(), self.vector.gradient_of(losses.sum())
