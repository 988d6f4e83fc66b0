"""Known mechanics, and a network for what they cannot say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from pydantic import NonNegativeFloat
from torch import Tensor

from pinn_dyn.mechanics import Integrator, Sum
from pinn_dyn.models.known import KnownMechanics
from pinn_dyn.models.lagrangian import LagrangianNetwork
from pinn_dyn.models.residual import NoResidual, ResidualHead
from pinn_dyn.models.scales import Scales
from pinn_dyn.models.statistics import Statistics


class KnownAndNetwork(Sum):
    """The sum of known mechanics and a Lagrangian network, with a residual force::

        (M_k + M_n) a + (C_k + C_n) v + G_k + G_n + (D_k + D_n) v + F_k + F_n = A_k u + r

    Known terms have the index k, those of the network n. The network has no input matrix of its
    own (``input: none``) and small terms at the start; what it contributes is penalized, so that it
    learns only what the known mechanics cannot say::

        penalty = w mean over the batch and i of (tau_i / f_i)^2
        tau = M_n a + C_n v + G_n + D_n v + F_n

    f is the typical torque of the drives.

    Args:
        statistics: scales of the data.
        known: builder of the known part.
        network: builder of the learned part.
        residual: builder of the residual force.
        weight: w.
        integrator: the method of integration.

    Raises:
        ValueError: on a weight that is negative or not finite, or a network with an input matrix, a
            residual force or a learned start.
    """

    def __init__(
        self,
        statistics: Statistics,
        known: Callable[..., KnownMechanics],
        network: Callable[..., LagrangianNetwork],
        residual: ResidualHead = NoResidual,
        weight: NonNegativeFloat = 0.01,
        integrator: Integrator | None = None,
    ):
        first = known(statistics=statistics)
        # The network works on forces: its scales are those of the torques, not of the currents.
        gain = first.drive_gain().detach().to(statistics.u_mean)
        forces = replace(statistics, u_mean=gain * statistics.u_mean, u_std=gain * statistics.u_std)
        second = network(statistics=forces)
        drives = second.input(statistics.q_mean[None].float()).any()
        for head, there, reason in (
            ("input", drives, "the known part drives the robot"),
            ("residual", second.has_residual, "the sum has it (model/residual=network)"),
            ("initial_velocity", second.learns_initial_state, "a sum learns no start"),
        ):
            if there:
                raise ValueError(
                    f"network.{head} is a head that a sum leaves out, as {reason}: remove it"
                )
        super().__init__({"known": first, "network": second}, integrator)
        self.weight = weight
        force = forces.u_rms
        self.register_buffer("force", force.float().clone())
        self.force: Tensor
        self.residual = residual(Scales(statistics, force, second.angles))
        self.has_residual = self.residual.learned
        self.penalized = True

    @property
    def known(self) -> KnownMechanics:
        """The known part."""
        part = self.parts["known"]
        assert isinstance(part, KnownMechanics)
        return part

    def penalty(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """Of the network's part, and of the residual force."""
        network = self.parts["network"]
        assert isinstance(network, LagrangianNetwork)
        share = network.inverse_dynamics(q, v, a) / self.force
        return self.weight * share.square().mean() + self.residual.penalty(q, v, u)

    def _applied_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        force = super()._applied_force(q, v, u)
        return force + self.residual(q, v, u) if self.has_residual else force

    def _residual_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return self.residual(q, v, u)
