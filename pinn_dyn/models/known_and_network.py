"""Sum of known mechanics and a network for the remaining forces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import cast

from pydantic import NonNegativeFloat
from torch import Tensor

from pinn_dyn.mechanics import Integrator, Sum
from pinn_dyn.models.cholesky import Positive
from pinn_dyn.models.input_matrix import NoInput
from pinn_dyn.models.known import KnownMechanics
from pinn_dyn.models.lagrangian import LagrangianNetwork
from pinn_dyn.models.residual import ResidualHead
from pinn_dyn.models.scales import Scales
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.models.structured import DAMPING, MASS, POTENTIAL

_SMALL = Positive(floor=0.0, initial=0.1)
SMALL_NETWORK = partial(
    LagrangianNetwork,
    mass=partial(MASS, positivity=_SMALL),
    potential=partial(POTENTIAL, quadratic=False, initial=0.0),
    damping=partial(DAMPING, positivity=_SMALL),
    input=NoInput,
)
"""Network whose terms are small at the start."""


class KnownAndNetwork(Sum):
    """Sum of known mechanics and a Lagrangian network, with a residual force::

        (M_k + M_n) a + (C_k + C_n) v + G_k + G_n + (D_k + D_n) v + F_k + F_n = A_k u + r

    Known terms have the index k, terms of the network the index n. The network has no input matrix
    (``input: none``), and its initial terms are small. With the typical torques f of the drives::

        penalty = w mean over the batch and i of (tau_i / f_i)^2
        tau = M_n a + C_n v + G_n + D_n v + F_n

    Args:
        statistics: scales of the data.
        known, network: builders of the parts. The default network has small initial terms.
        residual: builder of the residual force.
        weight: w.
        integrator: the integration method.

    Raises:
        ValueError: if the network has a head that a sum does not use.
    """

    def __init__(
        self,
        statistics: Statistics,
        known: Callable[..., KnownMechanics],
        network: Callable[..., LagrangianNetwork] = SMALL_NETWORK,
        residual: ResidualHead | None = None,
        weight: NonNegativeFloat = 0.01,
        integrator: Integrator | None = None,
    ):
        first = known(statistics=statistics)
        # The network computes forces. Its scales are those of torques, not of currents.
        force = first.typical_force[first.driven].to(statistics.u_mean)
        force = force.repeat(statistics.num_inputs // max(len(force), 1))
        forces = replace(statistics, u_mean=0 * force, u_std=force)
        second = network(statistics=forces)
        drives = second.input(statistics.q_mean[None].float()).any()
        for head, present in (
            ("input", drives),
            ("residual", second.has_residual),
            ("initial_velocity", second.learns_initial_state),
        ):
            if present:
                raise ValueError(f"network.{head} is a head without an effect in a sum: remove it")
        super().__init__({"known": first, "network": second}, integrator)
        self.weight = weight
        force = first.typical_force
        self.register_buffer("force", force.float().clone())
        self.force: Tensor
        self.residual = residual and residual(Scales(statistics, force, second.angles))
        self.has_residual = residual is not None
        self.penalized = True

    @property
    def known(self) -> KnownMechanics:
        """Known part of the sum."""
        return cast("KnownMechanics", self.parts["known"])

    def penalty(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """Return the penalty of the network's force and of the residual force."""
        network = cast("LagrangianNetwork", self.parts["network"])
        share = network.inverse_dynamics(q, v, a) / self.force
        penalty = self.weight * share.square().mean()
        return penalty if self.residual is None else penalty + self.residual.penalty(q, v, u)

    def applied_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        force = super().applied_force(q, v, u)
        return force if self.residual is None else force + self.residual(q, v, u)

    def largest_input(self) -> Tensor | None:
        return self.known.largest_input()

    def reachable_force(self, q: Tensor, v: Tensor, tau: Tensor) -> Tensor:
        return self.known.reachable_force(q, v, tau)

    def _residual_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return v.new_zeros(v.shape) if self.residual is None else self.residual(q, v, u)
