"""Derivatives of predicted motion by the constants of a model."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import RK4
from pinn_dyn.mechanics.integrators import Sticking
from pinn_dyn.mechanics.rollout import path_between
from pinn_dyn.mechanics.sliding import Sliding, hold
from pinn_dyn.models.learned_constants import LearnedConstants


def rollout_slopes(model: LearnedConstants, windows: Windows) -> Tensor:
    """Return the derivatives of predicted increments by z, ``(B, H, 2N, P)``.

    The state x = (q, v) and its sensitivity S = dx/dz ``(2N, P)`` are rolled out together by RK4::

        dS/dt = (S_v, -M^-1 (de/dx S + de/dz))

    e is the missing force of :class:`LearnedConstants`. With sticking friction, the derivatives are
    those of the steps of :class:`~.integrators.Sticking`. The model is in float64.
    """
    dynamics = _Sensitivity(model)
    x0 = windows.start("qv")
    start = torch.cat([x0, x0.new_zeros(len(windows), dynamics.size * dynamics.count)], dim=-1)
    with torch.no_grad():
        path = path_between(dynamics, dynamics.integrator, start, windows.t, windows.input)
    return dynamics.split(path[:, 1:])[1]


class _Sensitivity:
    """Dynamics of y = (x, S)."""

    def __init__(self, model: LearnedConstants):
        self.model, self.slopes = model, model.slopes()
        self.size = 2 * model.num_coordinates
        self.count = sum(p.numel() for p in model.parameters())
        inner = RK4(model.integrator.substeps)
        self.integrator = Sticking(inner) if isinstance(model.integrator, Sticking) else inner

    def split(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return x ``(*batch, 2N)`` and S ``(*batch, 2N, P)``."""
        sensitivity = y[..., self.size :].unflatten(-1, (self.size, self.count))
        return y[..., : self.size], sensitivity

    def state_derivative(self, y: Tensor, u: Tensor) -> Tensor:
        x, sensitivity = self.split(y)
        rate = self.model.velocity_derivative(x, u)
        q, v = x.chunk(2, dim=-1)
        change = self.change(sensitivity, q, v, rate.chunk(2, dim=-1)[1], u)
        fixed = torch.zeros_like(q, dtype=torch.bool)
        return _joined(rate, sensitivity.chunk(2, dim=-2)[1], self.solve(q, change, fixed, change))

    def integration_step(
        self, increment: Tensor, start: Tensor, inputs: Tensor, h: Tensor
    ) -> Tensor:
        return self.integrator.step(self, increment, start, inputs, h)

    def implicit_solver(self, x: Tensor, step: Tensor) -> Callable[[Tensor], Tensor]:
        raise NotImplementedError("sensitivities are integrated by RK4")

    def sliding(self, y: Tensor, inputs: Tensor, h: Tensor, implicit: bool) -> _SlidingSensitivity:
        return _SlidingSensitivity(self, y, inputs, h)

    def change(self, sensitivity: Tensor, *at: Tensor) -> Tensor:
        """Return de/dx S + de/dz, ``(*batch, N, P)``."""
        return self.slopes.by_state(*at) @ sensitivity + self.slopes.by_parameters(*at)

    def solve(self, q: Tensor, change: Tensor, fixed: Tensor, values: Tensor) -> Tensor:
        """Return dS_v/dt, with ``values`` ``(*batch, N, P)`` for fixed coordinates."""
        mass = self.model.mass_matrix(q)
        rows = fixed.unsqueeze(-1)
        values = torch.where(rows, values, 0.0)
        force = torch.where(rows, values, -change - mass @ values)
        return torch.cholesky_solve(force, torch.linalg.cholesky_ex(hold(mass, fixed))[0])


class _SlidingSensitivity:
    """Dynamics of y in a step with the symbols of :class:`Sliding`::

    dtau/dz = -(S_v + tau drate/dz) / rate,    ds/dz = (forward - ahead) dtau/dz / h
    """

    def __init__(self, dynamics: _Sensitivity, y: Tensor, inputs: Tensor, h: Tensor):
        self.dynamics, self.h = dynamics, h
        x, sensitivity = dynamics.split(y)
        q, v = x.chunk(2, dim=-1)
        motion = self.motion = Sliding(dynamics.model, x, inputs, h)
        self.v, self.start = v.unsqueeze(-1), sensitivity.chunk(2, dim=-2)[1]
        change = dynamics.change(
            sensitivity, q, v, motion.rate, inputs.mean(0), motion.forward.to(v)
        )
        slope = dynamics.solve(q, change, v == 0, 0 * change)
        self.tau = motion.stop.unsqueeze(-1)
        stopping = -(self.start + self.tau * slope) / motion.rate.unsqueeze(-1)
        self.tau_slope = torch.where(motion.stops.unsqueeze(-1), stopping, 0.0)
        turned = motion.forward.to(v) - motion.ahead.to(v)
        self.share_slope = turned.unsqueeze(-1) * self.tau_slope / h

    def state_derivative(self, y: Tensor, u: Tensor) -> Tensor:
        model, motion = self.dynamics.model, self.motion
        x, sensitivity = self.dynamics.split(y)
        rate = motion.state_derivative(x, u)
        q, v = x.chunk(2, dim=-1)
        change = self.dynamics.change(sensitivity, q, v, rate.chunk(2, dim=-1)[1], u, motion.share)
        forward, backward = (model._sliding_force(v, s + 0 * v) for s in (1, 0))
        change = change + (forward - backward).unsqueeze(-1) * self.share_slope
        change = self.dynamics.solve(q, change, motion.stuck, -self.start / self.h)
        return _joined(rate, sensitivity.chunk(2, dim=-2)[1], change)

    def ended(self, start: Tensor, before: Tensor, after: Tensor) -> Tensor:
        parts = [self.dynamics.split(y) for y in (start, before, after)]
        x = self.motion.ended(*(part[0] for part in parts))
        end = (parts[0][0] + x).chunk(2, dim=-1)[1].unsqueeze(-1)
        position, velocity = parts[2][1].chunk(2, dim=-2)
        velocity = torch.where(self.motion.stuck.unsqueeze(-1), 0.0, velocity)
        moved = self.start * self.tau + velocity * (self.h - self.tau)
        moved = parts[1][1].chunk(2, dim=-2)[0] + 0.5 * (moved + (self.v - end) * self.tau_slope)
        position = torch.where(self.motion.stops.unsqueeze(-1), moved, position)
        return _joined(x, position, velocity)


def _joined(x: Tensor, upper: Tensor, lower: Tensor) -> Tensor:
    return torch.cat([x, torch.cat([upper, lower], dim=-2).flatten(-2)], dim=-1)
