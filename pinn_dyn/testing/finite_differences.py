"""Finite differences, an independent check of analytic derivatives."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def slope(function: Callable[[float], Tensor], step: float = 1e-3) -> Tensor:
    """Return df/de at e = 0 by the five-point stencil, with an error of order step^4."""
    near = function(step) - function(-step)
    far = function(2 * step) - function(-2 * step)
    return (8 * near - far) / (12 * step)


def partial_derivatives(
    function: Callable[[Tensor], Tensor], x: Tensor, step: float = 1e-3
) -> Tensor:
    """Return the derivatives of a function by each entry of x ``(*batch, n)``, stacked last."""
    n = x.shape[-1]
    directions = torch.eye(n, dtype=x.dtype).reshape(n, *[1] * (x.dim() - 1), n)
    return slope(lambda e: function(x + e * directions), step).movedim(0, -1)


def largest(values: Tensor) -> float:
    """Return the largest magnitude, 0 without entries."""
    return max(values.detach().abs().flatten().tolist(), default=0.0)


def assert_near(
    actual: Tensor, expected: Tensor, tolerance: float, scale: float | Tensor | None = None
) -> None:
    """Compare with an error of ``tolerance`` times ``scale``, by default the largest entry."""
    scale = largest(expected) if scale is None else float(scale)
    torch.testing.assert_close(actual, expected, rtol=0, atol=tolerance * scale)


def product(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return the product of matrices ``(*batch, n, m)`` and vectors ``(*batch, m)``."""
    return torch.einsum("...ij,...j->...i", matrix, vector)
