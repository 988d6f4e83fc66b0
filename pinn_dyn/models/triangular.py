"""Products and solves with triangular factors, unrolled for few coordinates."""

from __future__ import annotations

import torch
from torch import Tensor

UNROLLED = 8
"""Largest N for which the sums are unrolled, so that a compiler can fuse them. For larger N the
graph would grow like N^2, and the library is faster, by a factor of 3 at N = 12."""


def square(factor: Tensor) -> Tensor:
    """Return L L^T, ``(*batch, N, N)``."""
    if factor.shape[-1] > UNROLLED:
        return factor @ factor.transpose(-1, -2)
    return (factor.unsqueeze(-2) * factor.unsqueeze(-3)).sum(-1)


def lower_solve(factor: Tensor, vector: Tensor) -> Tensor:
    """Solve L x = b for a lower triangular L ``(*batch, N, N)`` and b ``(*batch, N)``."""
    if vector.shape[-1] > UNROLLED:
        return torch.linalg.solve_triangular(factor, vector.unsqueeze(-1), upper=False).squeeze(-1)
    entries = [row.unbind(-1) for row in factor.unbind(-2)]
    x: list[Tensor] = []
    for row, right in zip(entries, vector.unbind(-1), strict=True):
        for j, solved in enumerate(x):
            right = right - row[j] * solved
        x.append(right / row[len(x)])
    return torch.stack(x).movedim(0, -1)


def upper_solve(factor: Tensor, vector: Tensor) -> Tensor:
    """Solve L^T x = b for a lower triangular L."""
    if vector.shape[-1] > UNROLLED:
        upper = factor.transpose(-1, -2)
        return torch.linalg.solve_triangular(upper, vector.unsqueeze(-1), upper=True).squeeze(-1)
    entries = [row.unbind(-1) for row in factor.unbind(-2)]
    x = list(vector.unbind(-1))
    for i in reversed(range(len(x))):
        for j in range(i + 1, len(x)):
            x[i] = x[i] - entries[j][i] * x[j]
        x[i] = x[i] / entries[i][i]
    return torch.stack(x).movedim(0, -1)
