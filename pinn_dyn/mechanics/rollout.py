"""Rollouts: integrate a state derivative under a sampled input."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from pinn_dyn.mechanics.arrays import require_finite
from pinn_dyn.mechanics.integrators import RK4, Dynamics, Integrator
from pinn_dyn.mechanics.signal import Signal


def rollout(
    derivative: Callable[[Tensor, Tensor], Tensor],
    x0: Tensor,
    t: Tensor,
    input: Signal,
    *,
    substeps: int = 1,
) -> Tensor:
    """Return states x(t_k), ``(*batch, T, S)``, of dx/dt = f(x, u(t)) from ``x0``, by RK4.

    Args:
        derivative: f, maps x ``(*batch, S)`` and u ``(*batch, M)`` to ``(*batch, S)``.
        x0: initial state, ``(*batch, S)``.
        t: times of the solution, ``(T,)``, s.
        input: u.
        substeps: steps of the integrator between two times of ``t``.
    """
    require_start(x0, t, input)
    flow: Any = SimpleNamespace(state_derivative=derivative)
    return x0.unsqueeze(-2) + path_between(flow, RK4(substeps), x0, t, input)


def require_start(x0: Tensor, t: Tensor, input: Signal) -> None:
    """Raise an error if times do not increase, batches differ, or the state is not finite."""
    if t.ndim != 1 or t.shape[0] < 2:
        raise ValueError(f"t has shape {tuple(t.shape)}, expected (T,) with at least 2 times")
    if not bool((t.diff() > 0).all()):
        raise ValueError("t must increase strictly; sort it and drop repeated times")
    if input.batch != x0.shape[:-1]:
        raise ValueError(
            f"u has batch shape {tuple(input.batch)}, expected that of x0, {tuple(x0.shape[:-1])}"
        )
    require_finite("the initial state x0", x0)


def path_between(
    dynamics: Dynamics, integrator: Integrator, x0: Tensor, t: Tensor, input: Signal
) -> Tensor:
    """Return increments x(t_k) - x(t_0), ``(*batch, T, S)``, without the checks of a rollout."""
    # Subtract t[0] before the cast, so that times of the solver and the input compare exactly.
    input = input.since(t[0])
    grid = step_grid(t - t[0], input.t.detach(), integrator.substeps).to(x0.dtype)
    path = integrator.path(dynamics, x0, grid, input.to(x0.device, x0.dtype))
    return path[:: integrator.substeps].movedim(0, -2)


def step_grid(t: Tensor, t_input: Tensor, substeps: int) -> Tensor:
    """Return the times of the integrator's steps, ``(substeps (T - 1) + 1,)``.

    Ends of steps within rounding of an input sample are moved to its exact time, since a held
    input jumps there.
    """
    fractions = torch.arange(substeps, dtype=t.dtype, device=t.device) / substeps
    inner = t[:-1, None] + (t[1:] - t[:-1])[:, None] * fractions
    grid = torch.cat([inner.flatten(), t[-1:]])
    right = torch.searchsorted(t_input, grid).clamp(1, t_input.shape[0] - 1)
    before, after = t_input[right - 1], t_input[right]
    nearest = torch.where(grid - before < after - grid, before, after)
    close = (grid - nearest).abs() < 1e-6 * (t[1:] - t[:-1]).min() / substeps
    return torch.where(close, nearest, grid)
