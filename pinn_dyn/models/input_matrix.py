"""Heads for the input matrix, learned or fixed."""

from __future__ import annotations

import abc
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pinn_dyn.models.mlp import MLP


class InputMatrix(nn.Module, abc.ABC):
    """A(q) ``(*batch, N, M)``."""

    @abc.abstractmethod
    def forward(self, q: Tensor) -> Tensor:
        """A(q), ``(*batch, N, M)``."""


class NetworkInput(InputMatrix):
    """A(q) = scale_i * network(q), reshaped to N x M (paper, figure A-NN).

    Args:
        size: N.
        inputs: M.
        scale: typical size of the entries of each column, ``(M,)``; from the data.
        mean, std: normalization of q, ``(N,)``; from the data.
        hidden: widths of the hidden layers.
        activation: activation of the hidden layers.
        bound: largest entry in units of the scale (scaled sigmoid), or None for no bound.

    Raises:
        ValueError: on a bound that is not positive.
    """

    scale: Tensor

    def __init__(
        self,
        *,
        size: int,
        inputs: int,
        scale: Tensor,
        mean: Tensor,
        std: Tensor,
        hidden: Sequence[int],
        activation: str = "softplus",
        bound: float | None = None,
    ):
        super().__init__()
        if bound is not None and not bound > 0:
            raise ValueError(f"bound is {bound}, expected a positive number or none")
        self.shape = (size, inputs)
        self.bound = bound
        self.network = MLP(size, size * inputs, hidden, activation, mean, std)
        self.register_buffer("scale", scale.float())

    def forward(self, q: Tensor) -> Tensor:
        """A(q), ``(*batch, N, M)``."""
        y = self.network(q).unflatten(-1, self.shape)
        if self.bound is not None:
            y = self.bound * (2 * torch.sigmoid(y) - 1)
        return self.scale * y


class ConstantInput(InputMatrix):
    """A = scale * parameters, the same at every q.

    Args:
        size: N.
        inputs: M.
        scale: typical size of the entries of each column, ``(M,)``; from the data.
        mean, std: not used by a constant; every head takes the same arguments from the model.
    """

    scale: Tensor

    def __init__(self, *, size: int, inputs: int, scale: Tensor, mean: Tensor, std: Tensor):
        super().__init__()
        self.raw = nn.Parameter(torch.eye(size, inputs))
        self.register_buffer("scale", scale.float())

    def forward(self, q: Tensor) -> Tensor:
        """A, ``(*batch, N, M)``."""
        value = self.scale * self.raw
        return value.expand(*q.shape[:-1], *value.shape)


class FixedInput(InputMatrix):
    """A = a given constant matrix, not learned.

    Args:
        size: N.
        inputs: M.
        scale, mean, std: not used; every head takes the same arguments from the model.
        value: the matrix, ``(N, M)``; the identity if None, which needs N = M.

    Raises:
        ValueError: if the matrix is not N x M.
    """

    value: Tensor

    def __init__(
        self,
        *,
        size: int,
        inputs: int,
        scale: Tensor,
        mean: Tensor,
        std: Tensor,
        value: Sequence[Sequence[float]] | None = None,
    ):
        super().__init__()
        matrix = torch.eye(inputs) if value is None else torch.tensor(value, dtype=torch.float32)
        if matrix.shape != (size, inputs):
            raise ValueError(
                f"FixedInput: value has shape {tuple(matrix.shape)}, expected ({size}, {inputs})"
            )
        self.register_buffer("value", matrix)

    def forward(self, q: Tensor) -> Tensor:
        """A, ``(*batch, N, M)``."""
        return self.value.expand(*q.shape[:-1], *self.value.shape)
