"""Heads for the input matrix, learned or fixed."""

from __future__ import annotations

import abc
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pinn_dyn.models.mlp import MLP


class InputMatrix(nn.Module, abc.ABC):
    """A(q) ``(*batch, N, M)``.

    Args:
        size: N.
        inputs: M.
    """

    def __init__(self, size: int, inputs: int):
        super().__init__()
        self.shape = (size, inputs)

    @abc.abstractmethod
    def forward(self, q: Tensor) -> Tensor:
        """A(q), ``(*batch, N, M)``."""

    def typical_force(self, u_rms: Tensor) -> Tensor:
        """Root mean square of each generalized force, ``(N,)``, before anything is learned.

        While A is unknown, every coordinate gets the root mean square over all inputs, ``(M,)``.
        """
        return u_rms.square().mean().sqrt().expand(self.shape[0])


class NetworkInput(InputMatrix):
    """A(q) = scale_i * network(q), reshaped to N x M (paper, figure A-NN).

    Args:
        size: N.
        inputs: M.
        scale: typical size of the entries of each column, ``(M,)``; from the data.
        mean, std: normalization of q, ``(N,)``; from the data.
        angles: which coordinates are angles, and enter the network as sine and cosine.
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
        angles: Sequence[int] = (),
        hidden: Sequence[int],
        activation: str = "softplus",
        bound: float | None = None,
    ):
        super().__init__(size, inputs)
        if bound is not None and not bound > 0:
            raise ValueError(f"bound is {bound}, expected a positive number or none")
        self.bound = bound
        self.network = MLP(size, size * inputs, hidden, activation, mean, std, angles)
        self.register_buffer("scale", scale.float())

    def forward(self, q: Tensor) -> Tensor:
        """A(q), ``(*batch, N, M)``."""
        y = self.network.linearize(q)[0].unflatten(-1, self.shape)
        if self.bound is not None:
            y = self.bound * (2 * torch.sigmoid(y) - 1)
        return self.scale * y


class ConstantInput(InputMatrix):
    """A = scale * parameters, the same at every q.

    Args:
        size: N.
        inputs: M.
        scale: typical size of the entries of each column, ``(M,)``; from the data.
        mean, std, angles: not used by a constant; every head takes the same arguments.
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
        angles: Sequence[int] = (),
    ):
        super().__init__(size, inputs)
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
        scale, mean, std, angles: not used; every head takes the same arguments from the model.
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
        angles: Sequence[int] = (),
        value: Sequence[Sequence[float]] | None = None,
    ):
        super().__init__(size, inputs)
        matrix = torch.eye(inputs) if value is None else torch.tensor(value, dtype=torch.float32)
        if matrix.shape != (size, inputs):
            raise ValueError(
                f"FixedInput: value has shape {tuple(matrix.shape)}, expected ({size}, {inputs})"
            )
        self.register_buffer("value", matrix)

    def forward(self, q: Tensor) -> Tensor:
        """A, ``(*batch, N, M)``."""
        return self.value.expand(*q.shape[:-1], *self.value.shape)

    def typical_force(self, u_rms: Tensor) -> Tensor:
        """Root mean square of A u for uncorrelated inputs, ``(N,)``."""
        force = (self.value.to(u_rms).square() @ u_rms.square()).sqrt()
        # A coordinate that no input reaches directly is moved by the others.
        return torch.where(force > 0, force, super().typical_force(u_rms))
