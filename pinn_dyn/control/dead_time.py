"""Prediction of the state over the dead time of the inputs."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from pinn_dyn.exports.model_functions import held_step
from pinn_dyn.exports.repeated import repeated, sharing
from pinn_dyn.mechanics import MechanicalSystem

_ROUNDING = 1e-6  # of periods


class DeadTime:
    """Compensation of inputs that act after a dead time d, by the state that the model predicts::

        x(t_k + d) = x(t_k) + integral from t_k to t_k + d of f(x, u(s - d)) ds
        u_k = law(x(t_k + d), reference(t_k + d))

    In the predicted state, the plant has no dead time: gains, an observer, a guard and predictive
    control are those for the plant without it. A disturbance acts for d before the law can react,
    and shifts the predicted state by d^2 / 2 of the acceleration that it causes.

    If inputs have different dead times, d is the longest, and the other inputs are held back by the
    difference, interpolated between two periods.

    Source: Smith 1957, Closer control of loops with dead time; Manitius and Olbrot 1979, Finite
    spectrum assignment problem for systems with delays.

    Args:
        model: the model that predicts, in float64.
        dead_time: d, s, one or M.
        period: time between two calls, s.

    Attributes:
        ahead: the longest d, s.
        size: number n of inputs that wait or act at the end of the dead time.
    """

    def __init__(self, model: MechanicalSystem, dead_time: ArrayLike, period: float):
        self.model = model
        times = np.resize(np.asarray(dead_time, dtype=float), model.num_inputs)
        self.ahead = float(times.max())
        self.size = n = math.ceil(self.ahead / period - _ROUNDING)
        self._position = torch.from_numpy(n - (self.ahead - times) / period)
        # Input k of the last n acts between the ends k and k + 1, from now on.
        ends = np.maximum(self.ahead + period * np.arange(-n, 1), 0.0)
        self._lengths = torch.from_numpy(np.diff(ends))

    def predict(self, q: Tensor, v: Tensor, past: Tensor) -> tuple[Tensor, Tensor]:
        """Return q and v after the dead time, from the last n inputs ``(*batch, n, M)``."""
        model = sharing(self.model)
        substeps = model.integrator.substeps
        lengths = (self._lengths / substeps).unsqueeze(-1).expand(*past.shape[:-1], 1)
        rows = torch.cat([past, lengths], dim=-1).repeat_interleave(substeps, dim=-2)

        def step(x: Tensor, row: Tensor) -> Tensor:
            h = row.reshape(-1, row.shape[-1])[0, -1]  # the same for all states
            q, v = x.chunk(2, dim=-1)
            return torch.cat(held_step(model, q, v, row[..., :-1], h), dim=-1)

        q, v = repeated("step", step, torch.cat([q, v], dim=-1), rows).chunk(2, dim=-1)
        return q, v

    def held_back(self, inputs: Tensor) -> Tensor:
        """Return the input to apply ``(*batch, M)``, of the last n and the new one."""
        number = torch.arange(inputs.shape[-1])
        before, after = self._position.floor().long(), self._position.ceil().long()
        return inputs[..., before, number].lerp(inputs[..., after, number], self._position - before)
