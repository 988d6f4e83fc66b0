"""Cholesky heads of mass and damping matrices, and limits of their outputs."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor, nn

from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models.mlp import Activation, Tape, columns, rows
from pinn_dyn.models.scales import Scales

UNROLLED = 8
"""Largest N for which sums are unrolled, which lets a compiler fuse them. For larger N the graph
would grow like N^2, and the library is faster: three times at N = 12."""


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


@dataclass(frozen=True)
class Positive:
    """L_ii = softplus(y_ii) + floor,   L_ij = y_ij.

    Args:
        floor: smallest diagonal entry, in units of the scale; 0 allows a semi-definite matrix.
        initial: initial diagonal entry without the floor; below 1 for a robot with small inertia.
    """

    floor: NonNegativeFloat = 1e-3
    initial: PositiveFloat = 1.0

    @property
    def start(self) -> float:
        """Inverse of the softplus at ``initial``."""
        return math.log(math.expm1(self.initial))

    def diagonal(self, y: Tensor) -> tuple[Tensor, Tensor]:
        return F.softplus(y) + self.floor, torch.sigmoid(y)

    def lower(self, y: Tensor) -> tuple[Tensor, Tensor]:
        return y, torch.ones_like(y)


@dataclass(frozen=True)
class Bounded:
    """L_ii = b sigmoid(y_ii) + floor,   L_ij = b (2 sigmoid(y_ij) - 1),   b the limit.

    This is the scaled sigmoid of the paper for a real arm. The initial diagonal is 0.63 b.

    Args:
        limit: b, in units of the scale.
        floor: smallest diagonal entry, in units of the scale.
    """

    limit: PositiveFloat = 3.5
    floor: NonNegativeFloat = 1e-3
    start = math.log(math.expm1(1.0))

    def diagonal(self, y: Tensor) -> tuple[Tensor, Tensor]:
        share = torch.sigmoid(y)
        return self.limit * share + self.floor, self.limit * share * (1 - share)

    def lower(self, y: Tensor) -> tuple[Tensor, Tensor]:
        share = torch.sigmoid(y)
        return self.limit * (2 * share - 1), 2 * self.limit * share * (1 - share)


Positivity = Positive | Bounded


_DIAGONAL_MARGIN = 0.2
"""Margin of diagonal outputs beyond their range on the data. An entry by a softplus then exceeds
0.82 = exp(-0.2) of its smallest value on the data."""
_CACHED = 1024  # configurations in a block whose values fit into the cache
_MARGIN = 0.1
"""Margin of all other outputs, in units of their range on the data."""


class CholeskyFactor(nn.Module, abc.ABC):
    """Lower triangular factor L(q) ``(*batch, N, N)`` of a positive semi-definite matrix L L^T.

    Attributes:
        transposed: true if the matrix is L^T L.
        chain: true if column j of L depends only on the coordinates after q_j.
        constant: true if L is the same at every q.
    """

    transposed: bool = False
    chain: bool = False
    constant: bool = False

    @abc.abstractmethod
    def linearize(self, q: Tensor) -> tuple[Tensor, Tape]:
        """Return L(q), ``(*batch, N, N)``, and the tape for :meth:`pullback`."""

    @abc.abstractmethod
    def linearize_along(self, q: Tensor, dq: Tensor) -> tuple[Tensor, Tensor, Tape]:
        """Return L(q), its change dL along dq, and the tape."""

    @abc.abstractmethod
    def pullback(self, tape: Tape, cotangent: Tensor) -> Tensor:
        """Return the gradient of <cotangent, L(q)> with respect to q, ``(*batch, N)``."""

    def forward(self, q: Tensor) -> Tensor:
        """Return L(q), ``(*batch, N, N)``."""
        return self.linearize(q)[0]

    def matrix(self, q: Tensor) -> Tensor:
        """Return L(q) L(q)^T, or L(q)^T L(q) if transposed, ``(*batch, N, N)``."""
        return square(self(q).transpose(-1, -2) if self.transposed else self(q))

    def product(self, q: Tensor, x: Tensor) -> Tensor:
        """Return the matrix times x, ``(*batch, N)``, in N^2 operations instead of N^3."""
        factor = self(q).transpose(-1, -2) if self.transposed else self(q)
        return matvec(factor, matvec(factor.transpose(-1, -2), x))


class NetworkCholesky(CholeskyFactor):
    """L(q) = diag(scale) * tril(network(q)), with a positive diagonal.

    The network has N (N + 1)/2 outputs y, the first N for the diagonal (paper, section Sub-Network
    Structures). ``positivity`` maps y to the entries of L. The input of the network saturates
    outside the data. After training, y is replaced by c + m tanh((y - c)/m), with c = y clipped to
    its range on the data, and a margin m: 0.2 on the diagonal, and a tenth of the range elsewhere.
    This bounds the eigenvalues of the matrix from both sides.

    In a chain of bodies, the entries of L in M = L^T L (``transposed``) are simpler functions of q
    than in M = L L^T (Featherstone 2005, "Efficient factorization of the joint-space inertia matrix
    for branched kinematic trees"). With revolute or prismatic joints from base to tip, column j of
    L in M = L^T L, and in M^-1 = L L^T, depends only on the joints after j (``chain``; a mask of
    the network).

    Args:
        scales: scales of the data. The value is the typical size of the rows of L, or of its
            columns if transposed, ``(N,)``.
        hidden, activation: widths and activation of the hidden layers.
        positivity: map from outputs to entries with a positive diagonal.
        transposed, chain: see :class:`CholeskyFactor`.

    Raises:
        ValueError: if ``chain`` needs wider hidden layers.
    """

    placement: Tensor
    order: Tensor
    output_limits: Tensor | None

    def __init__(
        self,
        scales: Scales,
        *,
        hidden: Sequence[PositiveInt],
        activation: Activation = "softplus",
        positivity: Positivity = Positive(),
        transposed: bool = False,
        chain: bool = False,
    ):
        super().__init__()
        self.size = size = scales.size
        self.positivity, self.transposed, self.chain = positivity, transposed, chain
        row, column = torch.tril_indices(size, size, offset=-1)
        after = [*range(size), *column.tolist()] if chain else None
        self.network = scales.network(size * (size + 1) // 2, hidden, activation, after)
        with torch.no_grad():  # start near a diagonal matrix
            last = self.network.linears[-1]
            last.weight.mul_(0.1)
            last.bias[:size] = positivity.start
        # vec(L) = y S with the placement S, which holds the scale and position of each entry.
        order = torch.cat([torch.arange(size) * (size + 1), row * size + column])
        placement = torch.zeros(len(order), size * size)
        sides = order % size if transposed else order // size
        placement[torch.arange(len(order)), order] = scales.value.float()[sides]
        self.register_buffer("placement", placement)
        self.register_buffer("order", order.unsqueeze(1), persistent=False)
        self.register_buffer("output_limits", None)  # none during training

    def linearize(self, q: Tensor) -> tuple[Tensor, Tape]:
        y, tape = self.network.linearize(q)
        values, slopes = self._entries(columns(y))
        return _matrices(self._assemble(values), q), (*tape, slopes)

    def linearize_along(self, q: Tensor, dq: Tensor) -> tuple[Tensor, Tensor, Tape]:
        y, dy, tape = self.network.linearize_along(q, dq)
        values, slopes = self._entries(columns(y))
        rate = self._assemble(slopes * columns(dy))
        return _matrices(self._assemble(values), q), _matrices(rate, q), (*tape, slopes)

    def pullback(self, tape: Tape, cotangent: Tensor) -> Tensor:
        dy = self._take(columns(cotangent.flatten(-2))) * tape[-1]
        return self.network.pullback(tape[:-1], rows(dy, cotangent[..., 0]))

    def limits_at(self, q: Tensor) -> Tensor:
        """Return smallest outputs, largest outputs and margins at q ``(B, N)``, ``(3, K)``."""
        with torch.no_grad():
            y = torch.cat([self.network(part) for part in q.split(_CACHED)])
        low, high = y.amin(0), y.amax(0)
        margin = (_MARGIN * (high - low)).clamp(min=1e-3)  # 1e-3 for constant outputs
        margin[: self.size] = _DIAGONAL_MARGIN
        return torch.stack([low, high, margin])

    def _entries(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return the entries of L in units of the scale, diagonal first, and their slopes in y."""
        if self.output_limits is None:
            return self._free_entries(y)
        low, high, margin = self.output_limits.reshape(3, -1, *[1] * (y.ndim - 1)).unbind()
        clipped = y.clamp(low, high)
        beyond = torch.tanh((y - clipped) / margin)
        values, slopes = self._free_entries(clipped + margin * beyond)
        return values, slopes * (1 - beyond * beyond)

    def _free_entries(self, y: Tensor) -> tuple[Tensor, Tensor]:
        diagonal, diagonal_slope = self.positivity.diagonal(y[: self.size])
        lower, lower_slope = self.positivity.lower(y[self.size :])
        return torch.cat([diagonal, lower]), torch.cat([diagonal_slope, lower_slope])

    def _scales(self, y: Tensor) -> Tensor:
        """Return the scale of each entry, with a shape that broadcasts with y ``(K, ...)``."""
        return self.placement.gather(1, self.order).reshape(-1, *[1] * (y.ndim - 1))

    def _assemble(self, values: Tensor) -> Tensor:
        """Build L ``(N, N, ...)`` from its entries ``(K, ...)``, without indexing for small N.

        The gradient of indexing is slower.
        """
        values = values * self._scales(values)
        if self.size > UNROLLED:
            flat = values.new_zeros(self.size**2, *values.shape[1:])
            flat = flat.index_copy(0, self.order[:, 0], values)
            return flat.unflatten(0, (self.size, self.size))
        diagonal, *lower = values.split([self.size, *range(1, self.size)])
        zero = torch.zeros_like(diagonal)
        pieces = [diagonal[:1], zero[1:]]
        for i, row in enumerate(lower, 1):
            pieces += [row, diagonal[i : i + 1], zero[i + 1 :]]
        return torch.cat(pieces).unflatten(0, (self.size, self.size))

    def _take(self, matrix: Tensor) -> Tensor:
        """Apply the transpose of :meth:`_assemble` to ``(N * N, B)``; return entries ``(K, B)``."""
        size = self.size
        if size > UNROLLED:
            entries = matrix.index_select(0, self.order[:, 0])
        else:
            lower = [matrix[i * size : i * size + i] for i in range(1, size)]
            entries = torch.cat([matrix[:: size + 1], *lower])
        return entries * self._scales(entries)


def _matrices(square: Tensor, like: Tensor) -> Tensor:
    """Reshape ``(N, N, B)`` to ``(*batch, N, N)``, with the batch of ``like`` ``(*batch, k)``."""
    size = square.shape[0]
    matrices = rows(square.flatten(0, 1), like).unflatten(-1, (size, size))
    # Make it contiguous once; otherwise the library copies the matrix at every solve.
    return matrices.contiguous() if size > UNROLLED else matrices


class _ConstantFactor(CholeskyFactor):
    constant = True

    def linearize_along(self, q: Tensor, dq: Tensor) -> tuple[Tensor, Tensor, Tape]:
        factor, tape = self.linearize(q)
        return factor, torch.zeros_like(factor), tape

    def pullback(self, tape: Tape, cotangent: Tensor) -> Tensor:
        return torch.zeros_like(cotangent[..., 0])


class ConstantCholesky(_ConstantFactor):
    """L = diag(scale) * tril(parameters), constant.

    Args:
        scales: scales of the data. The value is the typical size of the rows of L, ``(N,)``.
        positivity: map from parameters to entries with a positive diagonal.
    """

    scale: Tensor

    def __init__(self, scales: Scales, *, positivity: Positivity = Positive()):
        super().__init__()
        self.positivity = positivity
        self.raw_diagonal = nn.Parameter(torch.full((scales.size,), positivity.start))
        self.lower = nn.Parameter(torch.zeros(scales.size, scales.size))
        self.register_buffer("scale", scales.value.float())

    def linearize(self, q: Tensor) -> tuple[Tensor, Tape]:
        diagonal, _ = self.positivity.diagonal(self.raw_diagonal)
        lower, _ = self.positivity.lower(self.lower)
        factor = (torch.diag_embed(diagonal) + lower.tril(-1)) * self.scale.unsqueeze(-1)
        return factor.expand(*q.shape[:-1], *factor.shape), ()


class FixedCholesky(_ConstantFactor):
    """Cholesky factor L of a fixed symmetric positive semi-definite matrix.

    Args:
        scales: scales of the data.
        value: the matrix, ``(N, N)``.

    Raises:
        ValueError: if the matrix is not N x N, symmetric and positive semi-definite.
    """

    factor: Tensor

    def __init__(self, scales: Scales, *, value: Sequence[Sequence[float]]):
        super().__init__()
        size = scales.size
        matrix = torch.tensor(value, dtype=torch.float64)
        eigenvalues, vectors = torch.linalg.eigh(matrix)
        symmetric = matrix.shape == (size, size) and torch.equal(matrix, matrix.T)
        if not symmetric or eigenvalues[0] < -1e-12 * eigenvalues[-1].abs():
            raise ValueError(
                f"FixedCholesky: value is {value}, expected a symmetric positive semi-definite "
                f"({size}, {size}) matrix"
            )
        # The QR factor of the square root is a Cholesky factor, even if the matrix is singular.
        upper = torch.linalg.qr((vectors * eigenvalues.clamp(min=0).sqrt()).T).R
        sign = torch.where(upper.diagonal() < 0, -1.0, 1.0).to(upper)
        self.register_buffer("factor", (sign[:, None] * upper).T.float().contiguous())

    def linearize(self, q: Tensor) -> tuple[Tensor, Tape]:
        return self.factor.expand(*q.shape[:-1], *self.factor.shape), ()


_NAME = "output_limits"  # name of the buffer
_CONFIGURATIONS = 20_000  # largest number of evaluated configurations


def output_limits(model: nn.Module, q: Tensor) -> dict[str, Tensor]:
    """Compute the output limits of all heads by name, from training configurations ``(K, N)``."""
    q = q[:: -(-len(q) // _CONFIGURATIONS)]
    return {f"{name}.{_NAME}": head.limits_at(q) for name, head in _heads(model)}


def set_output_limits(model: nn.Module, limits: Mapping[str, Tensor]) -> None:
    """Set the output limits of the heads of a model by name; remove limits that are not named."""
    for name, head in _heads(model):
        head.output_limits = limits.get(f"{name}.{_NAME}")


def free_weights(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights of a checkpoint without output limits."""
    return {name: value for name, value in weights.items() if not name.endswith(f".{_NAME}")}


def _heads(model: nn.Module) -> list[tuple[str, NetworkCholesky]]:
    return [(n, head) for n, head in model.named_modules() if isinstance(head, NetworkCholesky)]
