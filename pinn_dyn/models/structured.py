"""What the Lagrangian and the Hamiltonian network share: heads for V, D and A."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pinn_dyn.mechanics import Coordinates, MechanicalSystem
from pinn_dyn.models.cholesky import CholeskyFactor
from pinn_dyn.models.input_matrix import InputMatrix
from pinn_dyn.models.potential import NetworkPotential
from pinn_dyn.models.statistics import Statistics

CholeskyHead = Callable[..., CholeskyFactor]
"""Builds a Cholesky head from ``size``, ``scale``, ``mean`` and ``std``."""
PotentialHead = Callable[..., NetworkPotential]
"""Builds a potential head from ``size``, ``scale``, ``mean`` and ``std``."""
InputHead = Callable[..., InputMatrix]
"""Builds an input head from ``size``, ``inputs``, ``scale``, ``mean`` and ``std``."""


class StructuredNetwork(MechanicalSystem):
    """A mechanical system with learned V(q), D(q) and A(q); subclasses add the mass.

    The scales of the heads come from the data, so that every network works on numbers near one:
    with f the root mean square of the input, D ~ f/v, V ~ f q, A ~ f/u.
    """

    def __init__(
        self,
        statistics: Statistics,
        coordinates: Coordinates,
        potential: PotentialHead,
        damping: CholeskyHead,
        input: InputHead,
    ):
        size, inputs = statistics.num_coordinates, statistics.num_inputs
        super().__init__(size, inputs, coordinates)
        mean, std = statistics.q_mean, statistics.q_std
        force = statistics.force
        self.potential = potential(size=size, scale=force * float(std.mean()), mean=mean, std=std)
        self.damping = damping(
            size=size, scale=(force / statistics.v_std).sqrt(), mean=mean, std=std
        )
        self.input = input(
            size=size, inputs=inputs, scale=force / statistics.u_rms, mean=mean, std=std
        )

    def potential_energy(self, q: Tensor) -> Tensor:
        """V(q), ``(*batch,)``, J."""
        return self.potential(q)

    def damping_matrix(self, q: Tensor) -> Tensor:
        """D(q) = L_D L_D^T, ``(*batch, N, N)``."""
        return self.damping.matrix(q)

    def input_matrix(self, q: Tensor) -> Tensor:
        """A(q), ``(*batch, N, M)``."""
        return self.input(q)

    def _potential_force(self, q: Tensor) -> Tensor:
        return self.potential.gradient(q)


def lower_solve(factor: Tensor, vector: Tensor) -> Tensor:
    """x with L x = b, for a lower triangular L ``(*batch, N, N)`` and b ``(*batch, N)``.

    Unrolled over N: for the few coordinates of a robot this is faster than a batched LAPACK call,
    and its derivative is made of the same few operations.
    """
    x: list[Tensor] = []
    for i in range(vector.shape[-1]):
        rest = vector[..., i]
        for j in range(i):
            rest = rest - factor[..., i, j] * x[j]
        x.append(rest / factor[..., i, i])
    return torch.stack(x, dim=-1)


def upper_solve(factor: Tensor, vector: Tensor) -> Tensor:
    """x with L^T x = b, for the same lower triangular L."""
    size = vector.shape[-1]
    x: list[Tensor] = [vector[..., 0]] * size
    for i in reversed(range(size)):
        rest = vector[..., i]
        for j in range(i + 1, size):
            rest = rest - factor[..., j, i] * x[j]
        x[i] = rest / factor[..., i, i]
    return torch.stack(x, dim=-1)
