"""Decompositions into operations that all exports have, and factorizations of small matrices."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

_SWEEPS = 6  # of Jacobi rotations


def cholesky(matrix: Tensor) -> Tensor:
    """Return the lower L with L L^T = matrix, ``(*batch, n, n)``; NaN if there is no such L."""
    columns: list[Tensor] = []
    size = matrix.shape[-1]
    for j in range(size):
        column = matrix[..., 0] / matrix[..., :1, 0].sqrt()
        columns.append(torch.nn.functional.pad(column, (j, 0)))
        below = column[..., 1:]
        matrix = matrix[..., 1:, 1:] - below.unsqueeze(-1) * below.unsqueeze(-2)
    return torch.stack(columns, dim=-1)


def solve_triangular(matrix: Tensor, right: Tensor, upper: bool) -> Tensor:
    """Return X ``(*batch, n, k)`` with matrix X = right, for a triangular matrix."""
    size = matrix.shape[-1]
    rows: dict[int, Tensor] = {}
    for i in reversed(range(size)) if upper else range(size):
        rows[i] = right[..., -1 if upper else 0, :] / matrix[..., i, i : i + 1]
        unsolved = slice(0, i) if upper else slice(i + 1, size)
        right = right[..., :-1, :] if upper else right[..., 1:, :]
        right = right - matrix[..., unsolved, i : i + 1] * rows[i].unsqueeze(-2)
    return torch.stack([rows[i] for i in range(size)], dim=-2)


def qr(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Return Q ``(*batch, n, k)`` and R ``(*batch, k, k)`` by Householder reflections, n >= k."""
    rows, columns = matrix.shape[-2:]
    R = matrix
    reflections = []
    for j in range(min(columns, rows - 1)):
        x = R[..., j:, j]
        sign = torch.where(x[..., :1] < 0, -1.0, 1.0)
        norm = (x * x).sum(-1, keepdim=True).sqrt()
        w = torch.cat([x[..., :1] + sign * norm, x[..., 1:]], dim=-1)
        w = torch.nn.functional.pad(w, (j, 0))
        scale = 2 / (w * w).sum(-1, keepdim=True)
        reflections.append((w, scale))
        R = R - (scale * w).unsqueeze(-1) * (w.unsqueeze(-1) * R).sum(-2, keepdim=True)
    Q = torch.eye(rows, columns, dtype=matrix.dtype).expand(matrix.shape)
    for w, scale in reversed(reflections):
        Q = Q - (scale * w).unsqueeze(-1) * (w.unsqueeze(-1) * Q).sum(-2, keepdim=True)
    return Q, R[..., :columns, :].triu()


def pseudo_inverse(matrix: Tensor, rtol: Any) -> Tensor:
    """Return the pseudo-inverse ``(*batch, k, n)`` of a small matrix.

    Six sweeps of Jacobi rotations make the columns orthogonal. Singular values up to ``rtol`` times
    the largest count as zero.

    Source: Hestenes 1958, "Inversion of matrices by biorthogonalization and related results".
    """
    size = matrix.shape[-1]
    unit = torch.eye(size, dtype=matrix.dtype)
    vectors = unit
    for i, j in [*itertools.combinations(range(size), 2)] * _SWEEPS:
        a, b = matrix[..., i], matrix[..., j]
        difference, product = ((b - a) * (b + a)).sum(-1), 2 * (a * b).sum(-1)
        length = (difference * difference + product * product).sqrt()
        total = difference + torch.where(difference < 0, -length, length)
        tangent = torch.where(total == 0, 0.0, product / torch.where(total == 0, 1.0, total))
        cosine = 1 / (1 + tangent * tangent).sqrt()
        plane = unit[i].diag() + unit[j].diag()
        turn = unit[i].outer(unit[j]) - unit[j].outer(unit[i])
        cosine, sine = cosine[..., None, None], (tangent * cosine)[..., None, None]
        rotation = unit + (cosine - 1) * plane + sine * turn
        matrix, vectors = matrix @ rotation, vectors @ rotation
    squares = (matrix * matrix).sum(-2, keepdim=True)
    is_zero = squares <= rtol * rtol * squares.amax(-1, keepdim=True)
    inverse = torch.where(is_zero, 0.0, 1 / torch.where(is_zero, 1.0, squares))
    return (vectors * inverse) @ matrix.mT


def _pinv(A: Tensor, *, atol: Any = None, rtol: Any = None, hermitian: bool = False) -> Any:
    return NotImplemented if rtol is None else pseudo_inverse(A, rtol)


def _cholesky_ex(matrix: Tensor, *, upper: bool = False, check_errors: bool = False) -> Any:
    failed = torch.zeros(matrix.shape[:-2], dtype=torch.int32)  # a failure gives NaN instead
    return cholesky(matrix), failed


def _cholesky_solve(right: Tensor, factor: Tensor, upper: bool = False) -> Tensor:
    lower = factor.mT if upper else factor
    return solve_triangular(lower.mT, solve_triangular(lower, right, upper=False), upper=True)


def _solve_ex(A: Tensor, B: Tensor, *, left: bool = True, check_errors: bool = False) -> Any:
    # Reflections need no pivots, so the operations do not depend on the numbers.
    Q, R = qr(A)
    vector = B.ndim == A.ndim - 1
    right = B.unsqueeze(-1) if vector else B
    result = solve_triangular(R, Q.mT @ right, upper=True)
    failed = torch.zeros(A.shape[:-2], dtype=torch.int32)
    return (result.squeeze(-1) if vector else result), A, failed, failed


def _inverse_ex(A: Tensor, *, check_errors: bool = False) -> Any:
    identity = torch.eye(A.shape[-1], dtype=A.dtype).expand(A.shape)
    inverse, _, _, failed = _solve_ex(A, identity)
    return inverse, failed


def _solve_triangular(
    A: Tensor, B: Tensor, *, upper: bool, left: bool = True, unitriangular: bool = False
) -> Tensor:
    if not left:
        return solve_triangular(A.mT, B.mT, not upper).mT
    return solve_triangular(A, B, upper)


def _clamp(x: Tensor, low: Any = None, high: Any = None) -> Tensor:
    for limit, limited in ((low, torch.maximum), (high, torch.minimum)):
        if limit is not None:
            number = not isinstance(limit, Tensor)
            x = limited(x, torch.full((), limit, dtype=x.dtype) if number else limit)
    return x


def _mean(x: Tensor, dims: Any = None, keep: bool = False, *, dtype: Any = None) -> Tensor:
    total = x.sum(dims or tuple(range(x.ndim)), keep)
    return total / (x.numel() // max(total.numel(), 1))


def _padded(x: Tensor, pads: Sequence[int], fill: float = 0.0) -> Tensor:
    for dim, *counts in zip(range(x.ndim - 1, -1, -1), pads[::2], pads[1::2], strict=False):
        shapes = ((*x.shape[:dim], count, *x.shape[dim + 1 :]) for count in counts)
        before, after = ([torch.full(shape, fill, dtype=x.dtype)] for shape in shapes)
        x = torch.cat([*before * (counts[0] > 0), x, *after * (counts[1] > 0)], dim)
    return x


def _cross(a: Tensor, b: Tensor, *, dim: int = -1) -> Tensor:
    def turned(x: Tensor, start: int) -> Tensor:
        return torch.cat([x.narrow(dim, start, 3 - start), x.narrow(dim, 0, start)], dim)

    return turned(a, 1) * turned(b, 2) - turned(a, 2) * turned(b, 1)


def _split(x: Tensor, size: int, dim: int = 0) -> Any:
    starts = range(0, x.shape[dim], size)
    return torch.split(x, [min(size, x.shape[dim] - k) for k in starts], dim)


def _softplus(x: Tensor, beta: float = 1.0, threshold: float = 20.0) -> Tensor:
    scaled = beta * x
    return torch.where(scaled > threshold, x, scaled.exp().log1p() / beta)


def _triangle(part: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def apply(x: Tensor, diagonal: int = 0) -> Tensor:
        mask = part(torch.ones(x.shape[-2:]), diagonal).bool()
        return torch.where(mask, x, torch.zeros((), dtype=x.dtype))

    return apply


def _remainder(x: Tensor, y: Any) -> Any:
    return x - y * (x / y).floor() if x.is_floating_point() else NotImplemented


def _scaled(operation: Callable[[Tensor, Any], Tensor]) -> Callable[..., Any]:
    return lambda x, y, alpha=1: NotImplemented if alpha == 1 else operation(x, alpha * y)


_aten = torch.ops.aten
# Also operations whose decompositions in PyTorch import its compiler, which takes seconds.
DECOMPOSITIONS: dict[Any, Callable[..., Any]] = {
    _aten.linalg_cholesky_ex.default: _cholesky_ex,
    _aten.cholesky_solve.default: _cholesky_solve,
    _aten._linalg_solve_ex.default: _solve_ex,
    _aten.addmm.default: lambda bias, a, b, beta=1, alpha=1: beta * bias + alpha * a.mm(b),
    _aten.bmm.default: lambda a, b: (a.unsqueeze(-1) * b.unsqueeze(-3)).sum(-2),
    _aten.linalg_inv_ex.default: _inverse_ex,
    _aten.linalg_qr.default: lambda A, mode="reduced": qr(A),
    _aten.linalg_pinv.atol_rtol_tensor: _pinv,
    _aten.linalg_solve_triangular.default: _solve_triangular,
    _aten.add.Tensor: _scaled(torch.add),
    _aten.sub.Tensor: _scaled(torch.sub),
    _aten.bitwise_and.Tensor: torch.logical_and,
    _aten.bitwise_not.default: torch.logical_not,
    _aten.bitwise_or.Tensor: torch.logical_or,
    _aten.constant_pad_nd.default: _padded,
    _aten.relu.default: lambda x: _clamp(x, 0.0),
    _aten.sigmoid.default: lambda x: (1 + (-x).exp()).reciprocal(),
    _aten.rsqrt.default: lambda x: x.sqrt().reciprocal(),
    _aten.linalg_cross.default: _cross,
    _aten.softplus.default: _softplus,
    _aten.split.Tensor: _split,
    _aten.tril.default: _triangle(torch.tril),
    _aten.triu.default: _triangle(torch.triu),
    _aten.stack.default: lambda xs, dim=0: torch.cat([x.unsqueeze(dim) for x in xs], dim),
    **dict.fromkeys((_aten.clamp.default, _aten.clamp.Tensor), _clamp),
    **dict.fromkeys((_aten.mean.default, _aten.mean.dim), _mean),
    **dict.fromkeys((_aten.ne.Scalar, _aten.ne.Tensor), lambda x, y: torch.logical_not(x == y)),
    **dict.fromkeys((_aten.remainder.Scalar, _aten.remainder.Tensor), _remainder),
}
