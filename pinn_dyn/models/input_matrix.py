"""Heads for the input matrix: learned or fixed, or one that depends on the input."""

from __future__ import annotations

import abc
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models.mlp import MLP


class InputMatrix(nn.Module, abc.ABC):
    """A(q) ``(*batch, N, M)``.

    Args:
        size: N.
        inputs: M.

    Attributes:
        affine: whether the force is A(q) u, with an A that does not depend on u.
    """

    affine: bool = True

    def __init__(self, size: int, inputs: int):
        super().__init__()
        self.shape = (size, inputs)

    @abc.abstractmethod
    def forward(self, q: Tensor) -> Tensor:
        """A(q), ``(*batch, N, M)``."""

    def force(self, q: Tensor, u: Tensor) -> Tensor:
        """The generalized force A(q) u, ``(*batch, N)``."""
        return matvec(self(q), u)

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
        u_mean, u_std: not used; every input head takes the same arguments.
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
        u_mean: Tensor | None = None,
        u_std: Tensor | None = None,
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


class NonlinearInput(InputMatrix):
    """tau = A(q, u) u with A(q, u) = scale_i * network(q, u), reshaped to N x M.

    The columns of the ``linear`` inputs are constants instead, and the network does not see those
    inputs. Of the rates of motors a log often says no more than that, and a network that depends on
    them finds more than there is.

    For inputs that are positions, not forces: a tendon that its motor tightens gets stiffer and
    pulls in another direction. With the motors' rates among the inputs (the step
    :class:`pinn_dyn.data.logs.InputRates`) the force on the robot is that of springs and dampers
    between motors and body, none of them linear. The controllers need an A(q) and refuse it.

    Args:
        size: N.
        inputs: M.
        scale: typical size of the entries of each column, ``(M,)``; from the data.
        mean, std: normalization of q, ``(N,)``; from the data.
        angles: which coordinates are angles, and enter the network as sine and cosine.
        u_mean, u_std: normalization of u, ``(M,)``; from the data.
        hidden: widths of the hidden layers.
        activation: activation of the hidden layers.
        linear: inputs with a constant column.

    Raises:
        ValueError: if ``linear`` names an input twice, one that is not there, or all of them.
    """

    affine = False
    scale: Tensor
    u_mean: Tensor

    def __init__(
        self,
        *,
        size: int,
        inputs: int,
        scale: Tensor,
        mean: Tensor,
        std: Tensor,
        angles: Sequence[int] = (),
        u_mean: Tensor,
        u_std: Tensor,
        hidden: Sequence[int],
        activation: str = "softplus",
        linear: Sequence[int] = (),
    ):
        super().__init__(size, inputs)
        self.curved = [k for k in range(inputs) if k not in linear]
        if len(self.curved) + len(linear) != inputs or not self.curved:
            raise ValueError(
                f"linear is {list(linear)}, expected some but not all of the {inputs} inputs, 0 to "
                f"{inputs - 1}, each once"
            )
        mean, std = torch.cat([mean, u_mean[self.curved]]), torch.cat([std, u_std[self.curved]])
        seen = len(self.curved)
        self.network = MLP(size + seen, size * seen, hidden, activation, mean, std, angles)
        self.constant = nn.Parameter(torch.zeros(size, len(linear))) if linear else None
        # Where each column of [curved, linear] belongs.
        self.order = sorted(range(inputs), key=[*self.curved, *linear].__getitem__)
        self.register_buffer("scale", scale.float())
        self.register_buffer("u_mean", u_mean.float())

    def forward(self, q: Tensor) -> Tensor:
        """A(q, u) at the mean input, ``(*batch, N, M)``."""
        return self._matrix(q, self.u_mean.expand(*q.shape[:-1], -1))

    def force(self, q: Tensor, u: Tensor) -> Tensor:
        """tau = A(q, u) u, ``(*batch, N)``."""
        return matvec(self._matrix(q, u), u)

    def _matrix(self, q: Tensor, u: Tensor) -> Tensor:
        if self.constant is None:
            y = self.network.linearize(torch.cat([q, u], dim=-1))[0]
            return self.scale * y.unflatten(-1, self.shape)
        y = self.network.linearize(torch.cat([q, u[..., self.curved]], dim=-1))[0]
        curved = y.unflatten(-1, (self.shape[0], len(self.curved)))
        constant = self.constant.expand(*curved.shape[:-1], -1)
        return self.scale * torch.cat([curved, constant], dim=-1)[..., self.order]


class ConstantInput(InputMatrix):
    """A = scale * parameters, the same at every q.

    Args:
        size: N.
        inputs: M.
        scale: typical size of the entries of each column, ``(M,)``; from the data.
        mean, std, angles, u_mean, u_std: not used by a constant; every input head takes the same
            arguments.
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
        u_mean: Tensor | None = None,
        u_std: Tensor | None = None,
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
        scale, mean, std, angles, u_mean, u_std: not used; every input head takes the same arguments
            from the model.
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
        u_mean: Tensor | None = None,
        u_std: Tensor | None = None,
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
