"""Derivatives of predicted motion by the constants of a model."""

from __future__ import annotations

import torch
from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import rollout
from pinn_dyn.models.learned_constants import LearnedConstants


def rollout_slopes(model: LearnedConstants, windows: Windows) -> Tensor:
    """Return the derivatives of predicted increments by z, ``(B, H, 2N, P)``.

    The state x = (q, v) and its sensitivity S = dx/dz ``(2N, P)`` are rolled out together by RK4::

        dS/dt = (S_v, -M^-1 (de/dx S + de/dz))

    e is the missing force of :class:`LearnedConstants`. The model is in float64.
    """
    size = model.num_coordinates
    count = sum(p.numel() for p in model.parameters())
    slopes = model.slopes()

    def derivative(state: Tensor, u: Tensor) -> Tensor:
        q, v = state[..., : 2 * size].chunk(2, dim=-1)
        sensitivity = state[..., 2 * size :].unflatten(-1, (2 * size, count))
        a = model.forward_dynamics(q, v, u)
        at = (q, v, a, u)
        change = slopes.by_state(*at) @ sensitivity + slopes.by_parameters(*at)
        factor = torch.linalg.cholesky_ex(model.mass_matrix(q))[0]
        rates = [sensitivity[..., size:, :], -torch.cholesky_solve(change, factor)]
        return torch.cat([v, a, torch.cat(rates, dim=-2).flatten(-2)], dim=-1)

    x0 = windows.start("qv")
    start = torch.cat([x0, x0.new_zeros(len(windows), 2 * size * count)], dim=-1)
    with torch.no_grad():
        substeps = model.integrator.substeps
        path = rollout(derivative, start, windows.t, windows.input, substeps=substeps)
    return path[:, 1:, 2 * size :].unflatten(-1, (2 * size, count))
