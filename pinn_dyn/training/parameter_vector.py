"""The parameters of a model as one vector."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn
from torch.optim import (
    SGD,
    Adadelta,
    Adagrad,
    Adam,
    Adamax,
    AdamW,
    NAdam,
    RAdam,
    RMSprop,
)

ELEMENTWISE = (Adam, AdamW, NAdam, RAdam, Adamax, Adagrad, Adadelta, RMSprop, SGD)
"""Optimizers that treat every number on its own: all parameters are one vector to them, and those
of E stacked models are E trainings."""


class ParameterVector:
    """The parameters of a model as one vector, of which each becomes a view; the gradients too.

    Clipping, and an optimizer that treats every number on its own, then take one operation where
    they took one for each parameter, which is most of the time of a small network's step.

    Args:
        parameters: of one model, or stacked over E members, ``(E, ...)``; on one device.
        members: E; None for a single model.

    Attributes:
        parameters: those of the model.
        values: all their numbers, ``(P,)``, or ``(E, P)`` of members; its ``grad`` holds theirs.
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
        """Give the parameters their part of the gradient, which others may take from them."""
        for parameter, gradient in zip(self.parameters, self._gradients, strict=True):
            parameter.grad = gradient

    def split(self, vector: Tensor) -> list[Tensor]:
        """A vector ``(..., P)`` as views of the shapes of the parameters, ``(..., *shape)``."""
        parts = vector.split(self._sizes, dim=-1)
        return [
            part.view((*part.shape[:-1], *shape))
            for part, shape in zip(parts, self._shapes, strict=True)
        ]

    def joined(self, gradients: Sequence[Tensor | None], leading: tuple[int, ...] = ()) -> Tensor:
        """Gradients ``(*leading, *shape)`` of the parameters as a vector ``(*leading, P)``.

        Those of None, which the loss does not depend on, are zero.
        """
        rows = [
            self.values.new_zeros(*leading, n) if one is None else one.reshape(*leading, n)
            for one, n in zip(gradients, self._sizes, strict=True)
        ]
        return torch.cat(rows, dim=-1)

    def gradient_of(self, loss: Tensor) -> Tensor:
        """That of a loss by autograd, in the shape of ``values``."""
        gradients = torch.autograd.grad(loss, self.parameters, allow_unused=True)
        return self.joined(gradients, tuple(self.values.shape[:-1]))
