"""Heads for the input matrix: learned, fixed, or a function of the input."""

from __future__ import annotations

import abc
from collections.abc import Sequence

import torch
from pydantic import NonNegativeInt, PositiveInt
from torch import Tensor, nn

from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.models.mlp import MLP, Activation
from pinn_dyn.models.scales import Scales


class InputMatrix(nn.Module, abc.ABC):
    """Input matrix A(q) ``(*batch, N, M)``. ``affine`` is true if A does not depend on u.

    Drives may add springs and damping to the equation of motion. By default there are none.
    """

    affine: bool = True

    def __init__(self, scales: Scales):
        super().__init__()
        self.shape = (scales.size, scales.inputs)

    @abc.abstractmethod
    def forward(self, q: Tensor) -> Tensor:
        """Return A(q), ``(*batch, N, M)``."""

    def force(self, q: Tensor, u: Tensor) -> Tensor:
        """Return the generalized force A(q) u, ``(*batch, N)``."""
        return matvec(self(q), u)

    def applied(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return the force of the inputs without springs and damping, ``(*batch, N)``."""
        return self.force(q, u)

    def springs(self) -> Tensor | None:
        """Return the stiffness that the drives add to the coordinates, ``(N,)``, or None."""
        return None

    def damping_rates(self) -> Tensor | None:
        """Return the damping that the drives add to the coordinates, ``(N,)``, or None."""
        return None

    def typical_input(self, q: Tensor) -> Tensor:
        """Return a typical input ``(*batch, M)``, for a force that is not linear in the input."""
        return q.new_zeros(*q.shape[:-1], self.shape[1])

    def typical_force(self, u_rms: Tensor) -> Tensor:
        """Return the initial root mean square of each force, ``(N,)``; 1 if there is no input."""
        force = u_rms.square().mean().sqrt() if len(u_rms) else u_rms.new_ones(())
        return force.expand(self.shape[0])


class NetworkInput(InputMatrix):
    """A(q) = scale_j * network(q), reshaped to N x M (paper, figure A-NN).

    The input of the network saturates outside the data. A is therefore bounded.

    Args:
        scales: scales of the data. The value is the typical size of the columns of A, ``(M,)``.
        hidden, activation: widths and activation of the hidden layers.
    """

    scale: Tensor

    def __init__(
        self, scales: Scales, *, hidden: Sequence[PositiveInt], activation: Activation = "softplus"
    ):
        super().__init__(scales)
        self.network = scales.network(scales.size * scales.inputs, hidden, activation)
        self.register_buffer("scale", scales.value.float())

    def forward(self, q: Tensor) -> Tensor:
        return self.scale * self.network.linearize(q)[0].unflatten(-1, self.shape)


class NonlinearInput(InputMatrix):
    """tau = A(q, u) u with A(q, u) = scale_j * network(q, u), reshaped to N x M.

    This head is for inputs that are positions instead of forces, such as the motors of tendons. A
    tightened tendon becomes stiffer and pulls in a different direction.

    The columns of the ``linear`` inputs are constants, and the network does not depend on these
    inputs. This prevents overfitting to motor rates.

    Args:
        scales: scales of the data. The value is the typical size of the columns of A, ``(M,)``.
        hidden, activation: widths and activation of the hidden layers.
        linear: inputs with a constant column.

    Raises:
        ValueError: if ``linear`` contains an input twice, an unknown input, or all inputs.
    """

    affine = False
    scale: Tensor
    u_mean: Tensor

    def __init__(
        self,
        scales: Scales,
        *,
        hidden: Sequence[PositiveInt],
        activation: Activation = "softplus",
        linear: Sequence[NonNegativeInt] = (),
    ):
        super().__init__(scales)
        size, inputs = self.shape
        self.curved = [k for k in range(inputs) if k not in linear]
        if len(self.curved) + len(linear) != inputs or not self.curved:
            raise ValueError(
                f"linear is {list(linear)}, expected different inputs from 0 to {inputs - 1}, but "
                "not all inputs"
            )
        data, curved = scales.statistics, len(self.curved)
        mean = torch.cat([data.q_mean, data.u_mean[self.curved]])
        std = torch.cat([data.q_std, data.u_std[self.curved]])
        sizes = size + curved, size * curved
        self.network = MLP(*sizes, hidden, activation, mean, std, scales.angles)
        self.constant = nn.Parameter(torch.zeros(size, len(linear))) if linear else None
        # Position of each input in the list [curved, linear].
        self.order = sorted(range(inputs), key=[*self.curved, *linear].__getitem__)
        self.register_buffer("scale", scales.value.float())
        self.register_buffer("u_mean", data.u_mean.float())

    def forward(self, q: Tensor) -> Tensor:
        """Return A(q, u) at the mean input, ``(*batch, N, M)``."""
        return self._matrix(q, self.typical_input(q))

    def typical_input(self, q: Tensor) -> Tensor:
        """Return the mean input of the data, ``(*batch, M)``."""
        return self.u_mean.expand(*q.shape[:-1], -1)

    def force(self, q: Tensor, u: Tensor) -> Tensor:
        return matvec(self._matrix(q, u), u)

    def _matrix(self, q: Tensor, u: Tensor) -> Tensor:
        y = self.network.linearize(torch.cat([q, u[..., self.curved]], dim=-1))[0]
        matrix = y.unflatten(-1, (self.shape[0], -1))
        if self.constant is not None:
            constant = self.constant.expand(*matrix.shape[:-1], -1)
            matrix = torch.cat([matrix, constant], dim=-1)[..., self.order]
        return self.scale * matrix


class ConstantInput(InputMatrix):
    """A = scale * parameters, constant, with a scale ``(M,)`` of the columns."""

    scale: Tensor

    def __init__(self, scales: Scales):
        super().__init__(scales)
        self.raw = nn.Parameter(torch.eye(*self.shape))
        self.register_buffer("scale", scales.value.float())

    def forward(self, q: Tensor) -> Tensor:
        value = self.scale * self.raw
        return value.expand(*q.shape[:-1], *value.shape)


class NoInput(InputMatrix):
    """A = 0, for a part of a sum without drives."""

    def forward(self, q: Tensor) -> Tensor:
        return q.new_zeros(*q.shape[:-1], *self.shape)

    def typical_force(self, u_rms: Tensor) -> Tensor:
        return u_rms if self.shape[0] == self.shape[1] else super().typical_force(u_rms)


class FixedInput(InputMatrix):
    """A fixed constant input matrix A.

    Args:
        scales: scales of the data.
        value: the matrix, ``(N, M)``. The default is the identity.

    Raises:
        ValueError: if the matrix is not N x M.
    """

    value: Tensor

    def __init__(self, scales: Scales, *, value: Sequence[Sequence[float]] | None = None):
        super().__init__(scales)
        size, inputs = self.shape
        matrix = torch.eye(inputs) if value is None else torch.tensor(value, dtype=torch.float32)
        if matrix.shape != (size, inputs):
            raise ValueError(
                f"FixedInput: value has shape {tuple(matrix.shape)}, expected ({size}, {inputs})"
            )
        self.register_buffer("value", matrix)

    def forward(self, q: Tensor) -> Tensor:
        return self.value.expand(*q.shape[:-1], *self.value.shape)

    def typical_force(self, u_rms: Tensor) -> Tensor:
        """Return the root mean square of A u for uncorrelated inputs, ``(N,)``."""
        force = (self.value.to(u_rms).square() @ u_rms.square()).sqrt()
        # The neighbors move a coordinate without a direct input.
        return torch.where(force > 0, force, super().typical_force(u_rms))
