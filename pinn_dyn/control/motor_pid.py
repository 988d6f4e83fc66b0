"""PID control of motor positions, a law with a single constant matrix from a model."""

from __future__ import annotations

import torch
from pydantic import NonNegativeFloat
from torch import Tensor

from pinn_dyn.control.contracts import Motion, Stage, Step, is_applied
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import jacobians, matvec

_RANK = 1e-15  # singular values below this share of the largest are zero


class MotorPID(Stage):
    """PID control of motors whose positions are the inputs::

        u = u_0 + J^+ (K_P e + K_I integral of e dt - K_D v),    e = q_ref - q

    Symbols: J = dq/du ``(N, M)``, the static gain of the model at the first configuration and its
    typical input u_0, constant for a run. The integral is held while an input is limited. A
    baseline for :class:`~.latent_law.LatentLaw`.

    Args:
        model: the mechanical system that gives J and u_0.
        position_gain, velocity_gain, integral_gain: K_P without a unit, K_D in s, K_I in 1/s.
    """

    needs_period = True

    def __init__(
        self,
        model: MechanicalSystem,
        position_gain: NonNegativeFloat = 0.5,
        velocity_gain: NonNegativeFloat = 0.0,
        integral_gain: NonNegativeFloat = 5.0,
    ):
        super().__init__(model.num_coordinates, model.num_inputs)
        self.model = model
        self.gains = position_gain, velocity_gain, integral_gain
        n, m = self.num_coordinates, self.num_inputs
        self._sizes = [n, m, m, m * n]
        self.memory_size = sum(self._sizes)

    def start(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return an integral of zero, no wanted input, u_0 and J^+."""
        model = self.model

        def force(q: Tensor, u: Tensor) -> Tensor:
            return model.applied_force(q, torch.zeros_like(q), u) - model.potential_force(q)

        typical = model.typical_input(q)
        _, (stiffness, slope) = jacobians(force, q, typical)
        inverse = torch.linalg.pinv(-torch.linalg.solve(stiffness, slope), rtol=_RANK)
        wanted = torch.full_like(u, torch.nan)  # the first call does not integrate
        return torch.cat([torch.zeros_like(q), wanted, typical, inverse.flatten(-2)], dim=-1)

    def step(
        self, q: Tensor, v: Tensor, reference: Motion, applied: Tensor, memory: Tensor
    ) -> Step:
        """Return u ``(*batch, M)``; a reference ``(N,)`` serves the whole batch."""
        integral, wanted, typical, inverse = memory.split(self._sizes, dim=-1)
        error = reference.q - q
        integral = integral + self.period * error * is_applied(wanted, applied)
        position, velocity, rate = self.gains
        feedback = position * error + rate * integral - velocity * v
        matrix = inverse.unflatten(-1, (self.num_inputs, self.num_coordinates))
        u = typical + matvec(matrix, feedback)
        return Step(u, torch.cat([integral, u, typical, inverse], dim=-1))
