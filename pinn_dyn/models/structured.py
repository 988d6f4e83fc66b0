"""Base class of Lagrangian and Hamiltonian networks, with heads for V, D, F and A."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from pinn_dyn.mechanics import Integrator, MechanicalSystem, State
from pinn_dyn.mechanics.integrators import with_friction
from pinn_dyn.models.cholesky import CholeskyFactor, NetworkCholesky, Positive
from pinn_dyn.models.friction import Friction, HasFriction
from pinn_dyn.models.input_matrix import InputMatrix, NetworkInput, NoInput
from pinn_dyn.models.potential import NetworkPotential, Potential
from pinn_dyn.models.residual import ResidualHead
from pinn_dyn.models.scales import Scales
from pinn_dyn.models.statistics import Statistics

CholeskyHead = Callable[[Scales], CholeskyFactor]
PotentialHead = Callable[[Scales], Potential]
InputHead = Callable[[Scales], InputMatrix]
FrictionHead = Callable[[Scales], Friction]
"""Builders of heads. The values of their scales are those of rows of L, V, columns of A and F."""

MASS = partial(NetworkCholesky, hidden=(32, 32, 32))
POTENTIAL = partial(NetworkPotential, hidden=(32, 32))
DAMPING = partial(NetworkCholesky, hidden=(16, 16), positivity=Positive(floor=0.0))
INPUT = partial(NetworkInput, hidden=(16, 16))
"""Default heads, those of the options named ``network`` in conf/model."""


class StructuredNetwork(HasFriction, MechanicalSystem):
    """Mechanical system with learned V, D, F, A and residual force. Subclasses add the mass.

    The scales of the heads come from the data: A ~ f/u with the root mean square f of the input,
    and D ~ f_i/v_i, F ~ f_i, r ~ f_i and V ~ f q with the typical force f_i of coordinate i.
    Without inputs, f is 1: the motion determines M, V, D and F only up to a common factor.
    """

    def __init__(
        self,
        statistics: Statistics,
        state: State,
        potential: PotentialHead,
        damping: CholeskyHead,
        friction: FrictionHead,
        input: InputHead,
        residual: ResidualHead | None,
        angles: Sequence[int],
        integrator: Integrator | None,
    ):
        super().__init__(statistics.num_coordinates, statistics.num_inputs, state)
        self.angles = tuple(angles)
        u_rms = statistics.u_rms
        head = input if len(u_rms) else NoInput
        self.input = head(self._scales(statistics, u_rms.square().mean().sqrt() / u_rms))
        force = self.input.typical_force(u_rms)
        energy = force.square().mean().sqrt() * statistics.q_std.mean()
        self.potential = potential(self._scales(statistics, energy))
        self.damping = damping(self._scales(statistics, (force / statistics.v_std).sqrt()))
        self.friction = friction(self._scales(statistics, force))
        if self.friction.by_load:
            raise ValueError("friction with a loss by load needs known drives: use model=known")
        self.sticking = self.friction.sticking
        if self.sticking and state == "qp":
            raise ValueError(
                "friction that sticks needs the state (q, v), not momenta: set model.state=qv, or "
                "model.friction.sticking=false for the smooth law"
            )
        self.integrator = with_friction(integrator, self.sticking)
        self.input_affine = self.input.affine
        self.residual = residual and residual(self._scales(statistics, force))
        self.has_residual = self.penalized = residual is not None

    def _scales(self, statistics: Statistics, value: Tensor) -> Scales:
        return Scales(statistics, value, self.angles)

    def potential_energy(self, q: Tensor) -> Tensor:
        springs, energy = self.input.springs(), self.potential(q)
        return energy if springs is None else energy + 0.5 * (springs * q * q).sum(-1)

    def damping_matrix(self, q: Tensor) -> Tensor:
        rates, matrix = self.input.damping_rates(), self.damping.matrix(q)
        return matrix if rates is None else matrix + torch.diag(rates)

    def damping_force(self, q: Tensor, v: Tensor) -> Tensor:
        rates, force = self.input.damping_rates(), self.damping.product(q, v)
        return force if rates is None else force + rates * v

    def stiffness_matrix(self, q: Tensor) -> Tensor | None:
        springs = self.input.springs()
        return None if springs is None else torch.diag(springs)

    def applied_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        force = self.input.applied(q, v, u)
        return force + self._residual_force(q, v, u) if self.has_residual else force

    def input_matrix(self, q: Tensor) -> Tensor:
        return self.input(q)

    def typical_input(self, q: Tensor) -> Tensor:
        return self.input.typical_input(q)

    def input_force(self, q: Tensor, u: Tensor) -> Tensor:
        return self.input.force(q, u)

    def _residual_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return v.new_zeros(v.shape) if self.residual is None else self.residual(q, v, u)

    def penalty(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        return v.new_zeros(()) if self.residual is None else self.residual.penalty(q, v, u)

    def _potential_force(self, q: Tensor) -> Tensor:
        springs, force = self.input.springs(), self.potential.gradient(q)
        return force if springs is None else force + springs * q
