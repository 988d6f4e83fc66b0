"""The parameters of a model as one vector."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn
from torch.optim import SGD, Adadelta, Adagrad, Adam, Adamax, AdamW, NAdam, RAdam, RMSprop

ELEMENTWISE = (Adam, AdamW, NAdam, RAdam, Adamax, Adagrad, Adadelta, RMSprop, SGD)
"""Optimizers that treat every number separately, so that all parameters can be one vector."""


class ParameterVector:
    """The parameters of a model and their gradients as views of two vectors.

    Args:
        parameters: the parameters.

    Attributes:
        parameters: the parameters.
        values: all numbers of the parameters, ``(P,)``, with all gradients.
    """

    def __init__(self, parameters: Iterable[nn.Parameter]):
        self.parameters = list(parameters)
        self._shapes = [p.shape for p in self.parameters]
        self._sizes = [shape.numel() for shape in self._shapes]
        self.values = nn.Parameter(torch.cat([p.detach().flatten() for p in self.parameters]))
        self.gradient = torch.zeros_like(self.values)
        self.values.grad = self.gradient
        for parameter, value in zip(self.parameters, self.split(self.values.detach()), strict=True):
            parameter.data = value
        self._gradients = self.split(self.gradient)
        self.show_gradients()

    def show_gradients(self) -> None:
        """Set the gradients of the parameters, which an optimizer or trainer may have removed."""
        for parameter, gradient in zip(self.parameters, self._gradients, strict=True):
            parameter.grad = gradient

    def split(self, vector: Tensor) -> list[Tensor]:
        """Split a vector ``(P,)`` into views of the shapes of the parameters."""
        parts = zip(vector.split(self._sizes), self._shapes, strict=True)
        return [part.view(shape) for part, shape in parts]

    def joined(self, gradients: Sequence[Tensor | None]) -> Tensor:
        """Join gradients of the shapes of the parameters, with None for zero, to ``(P,)``."""
        pairs = zip(gradients, self._sizes, strict=True)
        return torch.cat([self.values.new_zeros(n) if x is None else x.flatten() for x, n in pairs])

    def gradient_of(self, loss: Tensor) -> Tensor:
        """Return the gradient of a loss by autograd, ``(P,)``."""
        return self.joined(torch.autograd.grad(loss, self.parameters, allow_unused=True))
