"""Checks and small linear algebra on batched tensors."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor


def listed(value: Any) -> Any:
    """Convert an array or a tensor to a list or a number. Return other values unchanged."""
    return value.tolist() if isinstance(value, Tensor | np.ndarray | np.generic) else value


def require_last_dim(name: str, value: Tensor, size: int, symbol: str) -> None:
    """Check that a value has shape ``(*batch, size)``."""
    if value.ndim == 0 or value.shape[-1] != size:
        shape = tuple(value.shape)
        raise ValueError(
            f"{name} has shape {shape}, expected (*batch, {size}) with {symbol} = {size}"
        )


def require_finite(name: str, value: Tensor) -> None:
    """Check that a value is finite."""
    if math.isfinite(value.detach().sum()):  # several times faster than all entries
        return
    bad = ~torch.isfinite(value)
    if bad.any():
        first = tuple(int(i) for i in bad.nonzero()[0])
        raise ValueError(
            f"{name} has {int(bad.sum())} non-finite entries, the first at index {first} "
            f"({float(value[first])}): expected finite numbers only"
        )


def matvec(matrix: Tensor, vector: Tensor) -> Tensor:
    """Multiply matrices ``(*batch, n, m)`` and vectors ``(*batch, m)``."""
    return (matrix * vector.unsqueeze(-2)).sum(-1)


def jacobians(function: Callable[..., Tensor], *values: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Return y = f(a, b, ...) ``(*batch, n)`` and dy/da, dy/db, ..., ``(*batch, n, m)`` each.

    The function treats the rows ``(*batch, m)`` of its arguments independently.
    """
    slopes = []
    values = tuple(value.contiguous() for value in values)
    for index, value in enumerate(values):

        def of_value(x: Tensor, index: int = index) -> Tensor:
            return function(*values[:index], x, *values[index + 1 :])

        unit = torch.eye(value.shape[-1], dtype=value.dtype, device=value.device)
        # Forward mode, since torch.export records no torch.func.vjp.
        columns = [torch.func.jvp(of_value, (value,), (e.expand_as(value),))[1] for e in unit]
        slopes.append(torch.stack(columns, dim=-1))
    return function(*values), slopes


def pseudo_inverse_times(A: Tensor, tau: Tensor) -> Tensor:
    """Return A^+ tau, ``(*batch, M)``, for A ``(*batch, N, M)`` and tau ``(*batch, N)``.

    Rows of the batch where A is rank-deficient or not finite contain infinities or NaN.
    """
    rows, columns = A.shape[-2:]
    transposed = A.transpose(-1, -2)
    b = tau.expand(A.shape[:-1]).unsqueeze(-1)
    if rows == columns:
        x = torch.linalg.solve_ex(A, b).result
    elif rows < columns:
        Q, R = torch.linalg.qr(transposed)
        x = Q @ torch.linalg.solve_triangular(R.transpose(-1, -2), b, upper=False)
    else:
        Q, R = torch.linalg.qr(A)
        x = torch.linalg.solve_triangular(R, Q.transpose(-1, -2) @ b, upper=True)
    return x.squeeze(-1)


def spd_solve(matrix: Tensor, vector: Tensor) -> Tensor:
    """Solve ``matrix x = vector``; NaN where the matrix is not symmetric positive definite."""
    return spd_solver(matrix)(vector)


def spd_solver(matrix: Tensor) -> Callable[[Tensor], Tensor]:
    """Factor a matrix once and return the function :func:`spd_solve` of the vector."""
    factor, failed = torch.linalg.cholesky_ex(matrix)

    def solve(vector: Tensor) -> Tensor:
        solution = torch.cholesky_solve(vector.unsqueeze(-1), factor).squeeze(-1)
        return torch.where(failed.unsqueeze(-1) == 0, solution, torch.nan)

    return solve
