"""Heads for the mass and damping matrices: Cholesky factors, learned or fixed."""

from __future__ import annotations

import abc
from collections.abc import Sequence

import torch
from pydantic import PositiveInt
from torch import Tensor, nn

from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models.mlp import Activation, Tape, columns, rows
from pinn_dyn.models.positivity import Positive, Positivity
from pinn_dyn.models.scales import Scales
from pinn_dyn.models.triangular import UNROLLED, square

# Beyond the outputs on the data: a softplus far below zero is an exponential, exp(-0.2) = 0.82.
_DIAGONAL_MARGIN = 0.2
_MARGIN = 0.1


class CholeskyFactor(nn.Module, abc.ABC):
    """A lower triangular L(q) ``(*batch, N, N)``, for a matrix L L^T that is never indefinite.

    ``linearize`` returns L and a tape; ``pushforward`` gives dL for a tangent dq, ``pullback``
    gives the gradient in q for a cotangent of L, ``linearize_along`` the first two at once.

    Attributes:
        transposed: the matrix is L^T L instead, with L^T the upper triangular factor.
        chain: column j of L depends on the coordinates after q_j alone.
        constant: L is the same at every q.
    """

    transposed: bool = False
    chain: bool = False
    constant: bool = False

    @abc.abstractmethod
    def linearize(self, q: Tensor) -> tuple[Tensor, Tape]:
        """L(q), ``(*batch, N, N)``, and the tape for the passes below."""

    @abc.abstractmethod
    def pushforward(self, tape: Tape, dq: Tensor) -> Tensor:
        """dL, ``(*batch, N, N)``, for dq ``(*batch, N)``."""

    @abc.abstractmethod
    def pullback(self, tape: Tape, cotangent: Tensor) -> Tensor:
        """Gradient of <cotangent, L(q)> in q, ``(*batch, N)``."""

    def linearize_along(self, q: Tensor, dq: Tensor) -> tuple[Tensor, Tensor, Tape]:
        """L(q), dL for dq, and the tape."""
        factor, tape = self.linearize(q)
        return factor, self.pushforward(tape, dq), tape

    def forward(self, q: Tensor) -> Tensor:
        """L(q), ``(*batch, N, N)``."""
        return self.linearize(q)[0]

    def matrix(self, q: Tensor) -> Tensor:
        """L(q) L(q)^T, or L(q)^T L(q) if transposed, ``(*batch, N, N)``."""
        return square(self(q).transpose(-1, -2) if self.transposed else self(q))

    def product(self, q: Tensor, x: Tensor) -> Tensor:
        """The matrix times x, ``(*batch, N)``, by its factor: N^2 operations, not N^3."""
        factor = self(q).transpose(-1, -2) if self.transposed else self(q)
        return matvec(factor, matvec(factor.transpose(-1, -2), x))


class NetworkCholesky(CholeskyFactor):
    """L(q) = diag(scale) * tril(network(q)), with a positive diagonal.

    The network has N (N + 1)/2 outputs, the first N for the diagonal (paper, section Sub-Network
    Structures); ``positivity`` makes the entries of them. What the network sees of q saturates
    outside the data. Once trained, its outputs y saturate too, beyond what they were on the data,
    as in the corners of a box around the data no motion may ever have been: with c = y clipped to
    its smallest and largest value on the data and a margin m of 0.2 (diagonal) or a tenth of that
    range (others), y becomes c + m tanh((y - c)/m). So by construction every entry of L is nearly
    within what the data showed, and the eigenvalues of the matrix are bounded on either side.

    In a chain of bodies row i of L in M = L^T L (``transposed``) describes the bodies from joint i
    to the tip, so that most entries are simpler functions than those of L in M = L L^T
    (Featherstone 2005, "Efficient factorization of the joint-space inertia matrix for branched
    kinematic trees"). The scale is then that of the columns of L.

    In a serial chain of rigid bodies, whose coordinates are the joints from base to tip, M_ij with
    i >= j depends on the joints after j alone: turning the joints up to j moves all bodies that the
    two move like one. Then so does column j of L in M = L^T L, and in M^-1 = L L^T. With ``chain``
    the network cannot say otherwise: its weights are masked.

    Args:
        scales: of the data; the value is the typical size of the rows of L, ``(N,)``.
        hidden: widths of the hidden layers.
        activation: activation of the hidden layers.
        positivity: what keeps the diagonal positive.
        transposed: use L for L^T L.
        chain: let column j of L depend on the coordinates after q_j alone.

    Raises:
        ValueError: with ``chain`` on hidden layers of too few units.
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
        positivity: Positivity = Positive(),  # noqa: B008, it is frozen
        transposed: bool = False,
        chain: bool = False,
    ):
        super().__init__()
        size = scales.size
        self.size = size
        self.positivity = positivity
        self.transposed = transposed
        self.chain = chain
        row, column = torch.tril_indices(size, size, offset=-1)
        after = [*range(size), *column.tolist()] if chain else None
        self.network = scales.network(size * (size + 1) // 2, hidden, activation, after)
        with torch.no_grad():
            # Start near a diagonal matrix: a random off-diagonal part only has to be unlearned.
            last = self.network.linears[-1]
            last.weight.mul_(0.1)
            last.bias[:size] = positivity.start
        # vec(L) = y S, where S holds the scales and says which entry of y goes where.
        order = torch.cat([torch.arange(size) * (size + 1), row * size + column])
        placement = torch.zeros(len(order), size * size)
        placement[torch.arange(len(order)), order] = scales.value.float()[
            order % size if transposed else order // size
        ]
        self.register_buffer("placement", placement)
        self.register_buffer("order", order.unsqueeze(1), persistent=False)
        self.register_buffer("output_limits", None)  # while it learns

    def linearize(self, q: Tensor) -> tuple[Tensor, Tape]:
        y, tape = self.network.linearize(q)
        values, slopes = self._entries(columns(y))
        return _matrices(self._assemble(values), q), (*tape, slopes)

    def linearize_along(self, q: Tensor, dq: Tensor) -> tuple[Tensor, Tensor, Tape]:
        """L(q), dL for dq, and the tape, by one pass through the network."""
        y, dy, tape = self.network.linearize_along(q, dq)
        values, slopes = self._entries(columns(y))
        rate = self._assemble(slopes * columns(dy))
        return _matrices(self._assemble(values), q), _matrices(rate, q), (*tape, slopes)

    def pushforward(self, tape: Tape, dq: Tensor) -> Tensor:
        dy = columns(self.network.pushforward(tape[:-1], dq))
        return _matrices(self._assemble(tape[-1] * dy), dq)

    def pullback(self, tape: Tape, cotangent: Tensor) -> Tensor:
        dy = self._take(columns(cotangent.flatten(-2))) * tape[-1]
        return self.network.pullback(tape[:-1], rows(dy, cotangent[..., 0]))

    def limits_at(self, q: Tensor) -> Tensor:
        """Smallest and largest outputs at q ``(B, N)``, and the margin beyond, ``(3, K)``."""
        with torch.no_grad():
            y = self.network(q)
        low, high = y.amin(0), y.amax(0)
        margin = (_MARGIN * (high - low)).clamp(min=1e-3)  # of an output that is constant
        margin[: self.size] = _DIAGONAL_MARGIN
        return torch.stack([low, high, margin])

    def _entries(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Entries of L in units of its scale, the diagonal first, and their slopes in y."""
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
        """Scale of the row of L that each entry is in, to multiply y ``(K, ...)`` with."""
        return self.placement.gather(1, self.order).reshape(-1, *[1] * (y.ndim - 1))

    def _assemble(self, values: Tensor) -> Tensor:
        """L, ``(N, N, ...)``, from its entries ``(K, ...)``; cheaper than indexing backwards."""
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
        """The transpose of :meth:`_assemble`: entries ``(K, B)`` of a matrix ``(N * N, B)``."""
        size = self.size
        if size > UNROLLED:
            entries = matrix.index_select(0, self.order[:, 0])
        else:
            lower = [matrix[i * size : i * size + i] for i in range(1, size)]
            entries = torch.cat([matrix[:: size + 1], *lower])
        return entries * self._scales(entries)


def _matrices(square: Tensor, like: Tensor) -> Tensor:
    """``(N, N, B)`` as ``(*batch, N, N)``, for ``like`` ``(*batch, k)``; a view of small ones."""
    size = square.shape[0]
    matrices = rows(square.flatten(0, 1), like).unflatten(-1, (size, size))
    # The library copies what is not in rows, at every solve.
    return matrices.contiguous() if size > UNROLLED else matrices


class _ConstantFactor(CholeskyFactor):
    """An L that is the same at every q."""

    constant = True

    def pushforward(self, tape: Tape, dq: Tensor) -> Tensor:
        size = dq.shape[-1]
        return dq.new_zeros((*dq.shape[:-1], size, size))

    def pullback(self, tape: Tape, cotangent: Tensor) -> Tensor:
        return torch.zeros_like(cotangent[..., 0])


class ConstantCholesky(_ConstantFactor):
    """L = diag(scale) * tril(parameters), the same at every q.

    Args:
        scales: of the data; the value is the typical size of the rows of L, ``(N,)``.
        positivity: what keeps the diagonal positive.
    """

    scale: Tensor

    def __init__(self, scales: Scales, *, positivity: Positivity = Positive()):  # noqa: B008
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
    """L = the Cholesky factor of a given constant matrix, not learned.

    Args:
        scales: of the data.
        value: the symmetric positive semi-definite matrix, ``(N, N)``.

    Raises:
        ValueError: if the matrix is not N x N, not symmetric or not positive semi-definite.
    """

    factor: Tensor

    def __init__(self, scales: Scales, *, value: Sequence[Sequence[float]]):
        super().__init__()
        size = scales.size
        matrix = torch.tensor(value, dtype=torch.float64)
        if matrix.shape != (size, size) or not torch.equal(matrix, matrix.T):
            raise ValueError(
                f"FixedCholesky: value has shape {tuple(matrix.shape)}, expected a symmetric "
                f"({size}, {size}) matrix"
            )
        eigenvalues, vectors = torch.linalg.eigh(matrix)
        if eigenvalues[0] < -1e-12 * eigenvalues[-1].abs():
            raise ValueError(
                f"FixedCholesky: value has the eigenvalue {float(eigenvalues[0]):.4g}, expected "
                "a positive semi-definite matrix"
            )
        # A QR factor of the square root is a Cholesky factor that also exists for a singular one.
        root = (vectors * eigenvalues.clamp(min=0).sqrt()).T
        upper = torch.linalg.qr(root).R
        sign = torch.where(upper.diagonal() < 0, -1.0, 1.0).to(upper)
        self.register_buffer("factor", (sign[:, None] * upper).T.float().contiguous())

    def linearize(self, q: Tensor) -> tuple[Tensor, Tape]:
        return self.factor.expand(*q.shape[:-1], *self.factor.shape), ()
