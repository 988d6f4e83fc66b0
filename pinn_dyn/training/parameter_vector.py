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
        parameters: parameters of one model, or stacked over E members, ``(E, ...)``.
        members: E, or None for a single model.

    Attributes:
        parameters: the parameters.
        values: all numbers of the parameters, ``(P,)`` or ``(E, P)``, with all gradients.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], members: int | None = None):
        self.parameters = list(parameters)
        leading = () if members is None else (members,)
        self._shapes = [p.shape[len(leading) :] for p in self.parameters]
        self._sizes = [shape.numel() for shape in self._shapes]
        rows = [p.detach().reshape(*leading, -1) for p in self.parameters]
        self.values = nn.Parameter(torch.cat(rows, dim=-1))
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
        """Split a vector ``(..., P)`` into views of the parameters' shapes, ``(..., *shape)``."""
        parts = vector.split(self._sizes, dim=-1)
        pairs = zip(parts, self._shapes, strict=True)
        return [part.view((*part.shape[:-1], *shape)) for part, shape in pairs]

    def joined(self, gradients: Sequence[Tensor | None], leading: tuple[int, ...] = ()) -> Tensor:
        """Join gradients ``(*leading, *shape)``, with None for zero, to ``(*leading, P)``."""
        rows = [
            self.values.new_zeros(*leading, n) if value is None else value.reshape(*leading, n)
            for value, n in zip(gradients, self._sizes, strict=True)
        ]
        return torch.cat(rows, dim=-1)

    def gradient_of(self, loss: Tensor) -> Tensor:
        """Return the gradient of a loss by autograd, in the shape of ``values``."""
        gradients = torch.autograd.grad(loss, self.parameters, allow_unused=True)
        return self.joined(gradients, tuple(self.values.shape[:-1]))
