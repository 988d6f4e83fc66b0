"""PID control of motor positions, a law with a single constant matrix from a model."""

from __future__ import annotations

import math

import torch
from pydantic import NonNegativeFloat
from torch import Tensor

from pinn_dyn.control.contracts import Controller, Motion
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import jacobians, matvec


class MotorPID(Controller):
    """PID control of motors whose positions are the inputs::

        u = u_0 + J^+ (K_P e + K_I integral of e dt - K_D v),    e = q_ref - q

    Symbols: J = dq/du ``(N, M)``, the static gain of the model at the first configuration and its
    typical input u_0, constant for a run. A baseline for :class:`~.latent_law.LatentLaw`.

    Args:
        model: the mechanical system that gives J and u_0.
        position_gain, velocity_gain, integral_gain: K_P without a unit, K_D in s, K_I in 1/s.
    """

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
        self.reset()

    def reset(self) -> None:
        self._time = math.nan
        self._inverse = self._integral = torch.zeros(0)

    def __call__(self, t: float, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        """Return u ``(*batch, M)``; a reference ``(N,)`` serves the whole batch."""
        with torch.no_grad():
            error = reference.q - q
            if self._integral.shape != q.shape:
                self._start(q)
            else:
                self._integral = self._integral + (t - self._time) * error
            self._time = t
            position, velocity, integral = self.gains
            feedback = position * error + integral * self._integral - velocity * v
            return self._u + matvec(self._inverse, feedback)

    def _start(self, q: Tensor) -> None:
        model = self.model
        self._u, self._integral = model.typical_input(q), torch.zeros_like(q)

        def force(q: Tensor, u: Tensor) -> Tensor:
            return model._applied_force(q, torch.zeros_like(q), u) - model.potential_force(q)

        _, (stiffness, slope) = jacobians(force, q, self._u)
        self._inverse = torch.linalg.pinv(-torch.linalg.solve(stiffness, slope))
