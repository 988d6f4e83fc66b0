"""Losses whose gradients are known before the backward pass."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

Gradients = list[Tensor | None]
"""One entry for each parameter of the model, None where the loss does not depend on it."""


class KnownGradients(torch.autograd.Function):
    """The weighted sum of losses whose gradients are known: the backward pass hands them out.

    So it cannot be differentiated twice.
    """

    @staticmethod
    def forward(
        ctx: Any, parts: list[tuple[float, Tensor, Gradients]], *parameters: Tensor
    ) -> Tensor:
        """The sum over parts (weight, loss, gradients) of weight times loss."""
        ctx.weights = [weight for weight, _, _ in parts]
        ctx.gradients = list(zip(*(gradients for _, _, gradients in parts), strict=True))
        losses = [loss if weight == 1 else weight * loss for weight, loss, _ in parts]
        return losses[0] if len(losses) == 1 else torch.stack(losses).sum()

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """The weighted sum of the gradients."""
        weights = [float(upstream[0]) * weight for weight in ctx.weights]
        return None, *(_weighted(weights, values) for values in ctx.gradients)


def _weighted(weights: list[float], values: tuple[Tensor | None, ...]) -> Tensor | None:
    """The weighted sum; None where the loss does not depend on the parameter."""
    first, *rest = values
    if first is None:
        return None
    total = first if weights[0] == 1 else weights[0] * first
    for weight, value in zip(weights[1:], rest, strict=True):
        assert value is not None
        total.add_(value, alpha=weight)
    return total
