"""Baselines: predictors that a learned model has to beat."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from pinn_dyn.mechanics import Predictor, Signal, Trajectory
from pinn_dyn.models.linear_rival import fit_linear_rival

log = logging.getLogger(__name__)


class HoldPosition(Predictor):
    """q(t) = q(0), the prediction of a model that has learned nothing."""

    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        return torch.zeros_like(x0).unsqueeze(-2).expand(*x0.shape[:-1], len(t), x0.shape[-1])


class ConstantVelocity(Predictor):
    """q(t) = q(0) + v(0) t, which is hard to beat over a short time."""

    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        distance = x0[..., None, self.num_coordinates :] * (t - t[0]).to(x0)[:, None]
        return torch.cat([distance, torch.zeros_like(distance)], dim=-1)


def build_baselines(
    train: Sequence[Trajectory], validation: Sequence[Trajectory], *, step: float
) -> dict[str, Predictor]:
    """Build all baselines: hold position, constant velocity, ARX, and EDMDc of degree 2.

    The linear models of step ``step`` in s are fitted to the training trajectories, q ``(T, N)``
    each. The validation trajectories select their number of lags. A linear model that cannot be
    fitted is left out with a warning.
    """
    size, inputs = train[0].q.shape[-1], train[0].u.shape[-1]
    baselines: dict[str, Predictor] = {
        "hold position": HoldPosition(size, inputs),
        "constant velocity": ConstantVelocity(size, inputs),
    }
    degrees: dict[str, Literal[1, 2]] = {"ARX": 1, "EDMDc degree 2": 2}
    for name, degree in degrees.items():
        try:
            model = fit_linear_rival(train, validation, step=step, degree=degree)
        except ValueError as error:
            log.warning("no row '%s': %s", name, error)
            continue
        baselines[name] = model
        log.info("%s: %d lags of %g s, selected on the validation data", name, model.lags, step)
    return baselines
