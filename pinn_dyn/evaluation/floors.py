"""Floors and rivals: what a model has to beat before its figure means anything."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch
from torch import Tensor

from pinn_dyn.mechanics import Predictor, Signal, Trajectory
from pinn_dyn.models.linear_rival import fit_linear_rival

log = logging.getLogger(__name__)


class StandsStill(Predictor):
    """q(t) = q(0): what a model is worth that has learned nothing."""

    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        return torch.zeros_like(x0).unsqueeze(-2).expand(*x0.shape[:-1], len(t), x0.shape[-1])


class KeepsVelocity(Predictor):
    """q(t) = q(0) + v(0) t: over a short time hard to beat by anything."""

    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        v = x0[..., None, self.num_coordinates :]
        moved = v * (t - t[0]).to(x0)[:, None]
        return torch.cat([moved, torch.zeros_like(moved)], dim=-1)


def build_floors(
    train: Sequence[Trajectory], validation: Sequence[Trajectory], *, step: float
) -> dict[str, Predictor]:
    """Names and predictors: stands still, keeps its velocity, ARX, EDMDc of degree 2.

    The linear rivals are fitted to the training trajectories at this step, their lags chosen on
    the validation trajectories. One that cannot be fitted, as the training stretches are too short
    or too unevenly sampled, is left out with a warning.

    Args:
        train, validation: trajectories of the data source, q ``(T, N)`` each.
        step: step of the linear rivals, s.
    """
    size, inputs = train[0].q.shape[-1], train[0].u.shape[-1]
    floors: dict[str, Predictor] = {
        "stands still": StandsStill(size, inputs),
        "keeps its velocity": KeepsVelocity(size, inputs),
    }
    for name, degree in (("ARX", 1), ("EDMDc degree 2", 2)):
        try:
            rival = fit_linear_rival(train, validation, step=step, degree=degree)
        except ValueError as error:
            log.warning("no row '%s': %s", name, error)
            continue
        floors[name] = rival
        log.info("%s: %d lags of %g s, chosen on validation", name, rival.lags, step)
    return floors
