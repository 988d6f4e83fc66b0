"""What the Lagrangian and the Hamiltonian network share: heads for V, D, F and A."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from pinn_dyn.mechanics import RK4, Integrator, MechanicalSystem, State
from pinn_dyn.models.cholesky import CholeskyFactor
from pinn_dyn.models.friction import Friction
from pinn_dyn.models.input_matrix import InputMatrix
from pinn_dyn.models.potential import Potential
from pinn_dyn.models.statistics import Statistics

CholeskyHead = Callable[..., CholeskyFactor]
"""Builds a Cholesky head from ``size``, ``scale``, ``mean``, ``std`` and ``angles``."""
PotentialHead = Callable[..., Potential]
"""Builds a potential head from ``size``, ``scale``, ``mean``, ``std`` and ``angles``."""
InputHead = Callable[..., InputMatrix]
"""Builds an input head from ``size``, ``inputs``, ``scale``, ``mean``, ``std``, ``angles``,
``u_mean`` and ``u_std``."""
FrictionHead = Callable[..., Friction]
"""Builds a friction head from ``size``, ``force`` and ``v_std``."""


class StructuredNetwork(MechanicalSystem):
    """A mechanical system with learned V(q), D(q), F(v) and A(q); subclasses add the mass.

    The scales of the heads come from the data, so that every network works on numbers near one:
    with f the root mean square of the input, A ~ f/u, and with f_i the typical force that this
    gives on coordinate i, D ~ f_i/v_i, F ~ f_i, V ~ f q.
    """

    def __init__(
        self,
        statistics: Statistics,
        state: State,
        potential: PotentialHead,
        damping: CholeskyHead,
        friction: FrictionHead,
        input: InputHead,
        angles: Sequence[int],
        integrator: Integrator | None,
    ):
        size, inputs = statistics.num_coordinates, statistics.num_inputs
        super().__init__(size, inputs, state)
        self.integrator = integrator or RK4()
        self.angles = tuple(angles)
        mean, std, u_rms = statistics.q_mean, statistics.q_std, statistics.u_rms
        self.input = input(
            size=size,
            inputs=inputs,
            scale=u_rms.square().mean().sqrt() / u_rms,
            mean=mean,
            std=std,
            angles=angles,
            u_mean=statistics.u_mean,
            u_std=statistics.u_std,
        )
        self.input_affine = self.input.affine
        force = self.input.typical_force(u_rms)
        self.potential = potential(
            size=size,
            scale=float(force.square().mean().sqrt() * std.mean()),
            mean=mean,
            std=std,
            angles=angles,
        )
        self.damping = damping(
            size=size, scale=(force / statistics.v_std).sqrt(), mean=mean, std=std, angles=angles
        )
        self.friction = friction(size=size, force=force, v_std=statistics.v_std)

    def potential_energy(self, q: Tensor) -> Tensor:
        """V(q), ``(*batch,)``, J."""
        return self.potential(q)

    def damping_matrix(self, q: Tensor) -> Tensor:
        """D(q) = L_D L_D^T, ``(*batch, N, N)``."""
        return self.damping.matrix(q)

    def input_matrix(self, q: Tensor) -> Tensor:
        """A(q), ``(*batch, N, M)``."""
        return self.input(q)

    def _friction_force(self, v: Tensor) -> Tensor:
        return self.friction(v)

    def _friction_slope(self, v: Tensor) -> Tensor:
        return self.friction.slope(v)

    def _input_force(self, q: Tensor, u: Tensor) -> Tensor:
        return self.input.force(q, u)

    def _potential_force(self, q: Tensor) -> Tensor:
        return self.potential.gradient(q)


def lower_solve(factor: Tensor, vector: Tensor) -> Tensor:
    """x with L x = b, for a lower triangular L ``(*batch, N, N)`` and b ``(*batch, N)``.

    Unrolled over N: for the few coordinates of a robot this is faster than a batched LAPACK call,
    and its derivative is made of the same few operations.
    """
    entries = [row.unbind(-1) for row in factor.unbind(-2)]
    x: list[Tensor] = []
    for row, rest in zip(entries, vector.unbind(-1), strict=True):
        for j, known in enumerate(x):
            rest = rest - row[j] * known
        x.append(rest / row[len(x)])
    return torch.stack(x).movedim(0, -1)


def upper_solve(factor: Tensor, vector: Tensor) -> Tensor:
    """x with L^T x = b, for the same lower triangular L."""
    entries = [row.unbind(-1) for row in factor.unbind(-2)]
    x = list(vector.unbind(-1))
    for i in reversed(range(len(x))):
        for j in range(i + 1, len(x)):
            x[i] = x[i] - entries[j][i] * x[j]
        x[i] = x[i] / entries[i][i]
    return torch.stack(x).movedim(0, -1)
