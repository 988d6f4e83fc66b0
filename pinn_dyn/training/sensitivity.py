"""Predicted motion of windows, and its derivatives by the constants of a model."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics.integrators import Sticking
from pinn_dyn.mechanics.rollout import step_grid
from pinn_dyn.mechanics.sliding import Sliding, hold
from pinn_dyn.models.learned_constants import LearnedConstants

_CHUNK = 10_000  # steps whose derivatives are computed at once, to limit the memory


class WindowRollouts:
    """Rollouts of a model from the starts of B windows, with sensitivities S = dx/dz ``(2N, P)``::

        M (S_v' - S_v)/h + e_q (S_q + S_q')/2 + e_v (S_v + S_v')/2 + e_z = 0
        (S_q' - S_q)/h = (S_v + S_v')/2

    e is the missing force of :class:`LearnedConstants`. Its derivatives are those in the middle of
    a step of h seconds of the integrator (implicit midpoint rule), so the relative error of S is of
    the order h^2. A coordinate that sticks has S_v' = 0. With the symbols of
    :class:`~.sliding.Sliding`, a stop at tau changes the direction s of the friction in the step::

        dtau/dz = -(S_v + tau drate/dz) / rate,    ds/dz = (forward - ahead) dtau/dz / h

    Args:
        model, windows: the model and the windows, in float64.
    """

    def __init__(self, model: LearnedConstants, windows: Windows):
        self.model, self.start = model, windows.start("qv")
        self.substeps = model.integrator.substeps
        self.input = windows.input.since(windows.t[0])
        self.grid = step_grid(windows.t - windows.t[0], self.input.t, self.substeps)
        self._z, self._path = torch.empty(0), torch.empty(0)

    @torch.no_grad()
    def increments(self) -> Tensor:
        """Return the predicted increments, ``(B, H, 2N)``."""
        z = parameters_to_vector(self.model.parameters())
        if not torch.equal(z, self._z):  # derivatives follow at the same z
            self._path = self.model.integrator.path(self.model, self.start, self.grid, self.input)
            self._z = z
        return self._path[self.substeps :: self.substeps].movedim(0, 1)

    @torch.no_grad()
    def slopes(self) -> Tensor:
        """Return the derivatives of the increments by z, ``(B, H, 2N, P)``."""
        self.increments()
        parts = torch.arange(len(self.start)).split(max(_CHUNK // len(self.grid), 1))
        return torch.cat([self._slopes_of(part) for part in parts])

    def _slopes_of(self, part: Tensor) -> Tensor:
        x = self.start[part] + self._path[:, part]
        signal = self.input.mapped(lambda u: u[part])
        ((inputs, lengths),) = self.model.integrator.blocks(self.grid, signal, len(self.grid))
        steps = _Steps(self.model, x, inputs.transpose(0, 1), lengths[0])
        path = [torch.zeros_like(steps.added[0]).repeat(1, 2, 1)]
        for k in range(len(lengths)):
            path.append(steps.after(k, path[-1]))
        return torch.stack(path[self.substeps :: self.substeps], dim=1)


class _Steps:
    """Linear equations of K steps of B rollouts, ``S_v' - S_v = kept S + added + turned dF``.

    dF ``(N, P)`` is the change of the impulse of the friction by stops.

    Args:
        model: the model.
        x: states at the ends of the steps, ``(K + 1, B, 2N)``.
        inputs: inputs at the stages of the steps, ``(stages, K, B, M)``.
        h: length of a step, ``()``.
    """

    def __init__(self, model: LearnedConstants, x: Tensor, inputs: Tensor, h: Tensor):
        slopes, shape = model.slopes(), (len(x) - 1, x.shape[1])
        start, end = (y.flatten(0, 1) for y in (x[:-1], x[1:]))
        inputs = inputs.flatten(1, 2)
        q, v = ((start + end) / 2).chunk(2, dim=-1)
        at = [q, v, (end - start).chunk(2, dim=-1)[1] / h, inputs.mean(0)]
        stuck = torch.zeros_like(v, dtype=torch.bool)
        self.h, self.stops = h, None
        if isinstance(model.integrator, Sticking):
            motion = model.sliding(start, inputs, h, model.integrator.implicit)
            stuck, self.stops = motion.stuck, _stops_of(model, motion, start, at[3], shape[1])
            at.append(motion.share)
        by_q, by_v = slopes.by_state(*at).chunk(2, dim=-1)
        by_v = by_v + h / 2 * by_q
        # A coordinate that sticks loses its velocity: S_v' - S_v = -S_v.
        rows, unit = stuck[..., None], torch.eye(v.shape[-1]).to(v)
        matrix = torch.where(rows, unit, model.mass_matrix(q) + h / 2 * by_v)
        inverse = torch.linalg.inv_ex(matrix).inverse
        lost, kept = torch.cat([0 * unit, -unit], dim=-1), torch.cat([by_q, by_v], dim=-1)
        none = torch.zeros_like(h)
        equations = [(lost, -h * kept), (none, -h * slopes.by_parameters(*at)), (none, -unit)]
        self.kept, self.added, self.turned = (
            (inverse @ torch.where(rows, fixed, free)).unflatten(0, shape)
            for fixed, free in equations
        )

    def after(self, k: int, before: Tensor) -> Tensor:
        """Return S after step k from S before the step, ``(B, 2N, P)``."""
        position, velocity = before.chunk(2, dim=-2)
        change = self.kept[k] @ before + self.added[k]
        if self.stops is not None:
            stops = self.stops[k]
            tau_slope = stops.tau_slope(before[stops.rows])
            impulse = self.turned[k, stops.rows] @ (stops.jump * tau_slope)
            change = change.index_add(0, stops.rows, impulse)
        moved = position + self.h * (velocity + change / 2)
        return torch.cat([moved, velocity + change], dim=-2)


class _Stops(NamedTuple):
    """Stops in a step of R of the rollouts, with drate/dz = ``kept S + added``.

    ``stops``, ``tau``, ``rate`` and the ``jump`` of the friction at a stop are ``(R, N, 1)``.
    """

    rows: Tensor
    stops: Tensor
    tau: Tensor
    rate: Tensor
    jump: Tensor
    kept: Tensor
    added: Tensor

    def tau_slope(self, before: Tensor) -> Tensor:
        """Return dtau/dz, ``(R, N, P)``, from S ``(R, 2N, P)`` at the start of the step."""
        velocity = before.chunk(2, dim=-2)[1] + self.tau * (self.kept @ before + self.added)
        return torch.where(self.stops, -velocity / self.rate, 0.0)


def _stops_of(
    model: LearnedConstants, motion: Sliding, start: Tensor, u: Tensor, size: int
) -> list[_Stops]:
    """Return the stops in each step of ``size`` rollouts, with states ``(K size, 2N)``."""
    rows = motion.stops.any(-1).nonzero()[:, 0]
    q, v = start[rows].chunk(2, dim=-1)
    slopes, forward = model.slopes(), motion.forward[rows].to(v)
    at = (q, v, motion.rate[rows], u[rows], forward)
    # Coordinates at rest stay at rest until the stop of another.
    at_rest = (v == 0).unsqueeze(-1)
    inverse = torch.linalg.inv_ex(hold(model.mass_matrix(q), v == 0)).inverse
    kept, added = (
        inverse @ torch.where(at_rest, 0.0, -y)
        for y in (slopes.by_state(*at), slopes.by_parameters(*at))
    )
    upper, lower = (model.sliding_force(v, share + 0 * v) for share in (1.0, 0.0))
    jump = (upper - lower) * (forward - motion.ahead[rows].to(v))
    columns = [y[rows] for y in (motion.stops, motion.stop, motion.rate)]
    values = [rows % size, *(y.unsqueeze(-1) for y in (*columns, jump)), kept, added]
    counts = torch.bincount(rows // size, minlength=len(start) // size).tolist()
    return [_Stops(*parts) for parts in zip(*(y.split(counts) for y in values), strict=True)]
