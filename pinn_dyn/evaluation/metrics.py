"""Metrics of rollouts: configuration errors, divergence, and the spread of ensembles."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pinn_dyn.evaluation.prediction import Prediction
from pinn_dyn.mechanics import Trajectory

DIVERGENCE_FACTOR = 1e3
"""A rollout has diverged once its error exceeds this multiple of the spread of the true q."""
VALIDATION_ERROR = "val/error_mean"
"""Metric that summarizes a training; sweeps minimize it."""
BEST_BY = "val/error_windowed"
"""Metric that chooses the best checkpoint. A long rollout may err least before it learns."""


def validation_error(metrics: Mapping[str, float]) -> float:
    """Return the error that sweeps minimize: infinite if a rollout diverged, NaN if unknown."""
    if metrics.get("val/diverged", 0) > 0:
        return math.inf
    return metrics.get(VALIDATION_ERROR, math.nan)


def error_text(metrics: Mapping[str, float]) -> str:
    """Return the validation error as text, or the number of rollouts that diverged."""
    if diverged := metrics.get("val/diverged", 0):
        return f"{diverged:g} diverged"
    return f"{validation_error(metrics):.3g}"


def score(record: Mapping[str, Any]) -> str:
    """Return the validation error of a training as text, and the step whose model is kept."""
    text = error_text(record.get("validation", {}))
    if "kept_step" not in record or record["steps"] == 1:  # a fit of constants
        return text
    text += " (kept: step {kept_step} of {steps}".format(**record)
    if record["kept_step"] < record["steps"]:
        text += f"; last: {error_text(record['last_validation'])}"
    return f"{text})"


@dataclass(frozen=True)
class RolloutMetrics:
    """Errors of K rollouts, with e(t) = |q_hat(t) - q(t)|_2 in the units of q.

    Means, deviations and the median are over all times, the start included, of the trajectories
    that did not diverge. They are infinite if all diverged, never NaN.

    Attributes:
        trajectories: K.
        diverged: number of diverged trajectories, see :func:`diverged_trajectories`.
        horizon: length of the rollouts, s.
        error_mean, error_std: mean and (population) standard deviation of e.
        error_median: median of e.
        error_worst: largest mean of e over one trajectory; infinite if any diverged.
        worst_trajectory: index of that trajectory, the first diverged one if any.
        squared_error_mean, squared_error_variance: mean and (population) variance of e^2.
        valid_time: for each named threshold the first time in s at which e exceeds it, the horizon
            if it never does; mean over all trajectories.
    """

    trajectories: int
    diverged: int
    horizon: float
    error_mean: float
    error_std: float
    error_median: float
    error_worst: float
    worst_trajectory: int
    squared_error_mean: float
    squared_error_variance: float
    valid_time: dict[str, float]

    def to_dict(self) -> dict[str, float]:
        """Return all metrics in one flat dictionary; thresholds become ``valid_time_<name>``."""
        flat = {name: value for name, value in vars(self).items() if name != "valid_time"}
        return flat | {f"valid_time_{name}": time for name, time in self.valid_time.items()}


def rollout_metrics(
    q_hat: Tensor, q: Tensor, t: Tensor, *, thresholds: Mapping[str, float]
) -> RolloutMetrics:
    """Return the errors of predicted configurations.

    Args:
        q_hat: predicted configuration, ``(K, T, N)``.
        q: true configuration, ``(K, T, N)``, finite.
        t: times, ``(T,)``, s.
        thresholds: name and value, in the units of q, for each valid prediction time.
    """
    if q_hat.shape != q.shape:
        raise ValueError(f"q_hat has shape {tuple(q_hat.shape)} and q {tuple(q.shape)}")
    t = t.double() - t[0].double()
    prediction = Prediction(t, q_hat.double(), q.double())
    error, diverged = prediction.error(), diverged_trajectories(prediction)
    valid = error[~diverged]
    per_trajectory = torch.where(diverged, torch.inf, error.mean(dim=1))
    worst = int(per_trajectory.argmax())
    above = {name: ~(error <= value) for name, value in thresholds.items()}  # NaN is above all
    return RolloutMetrics(
        trajectories=len(q),
        diverged=int(diverged.sum()),
        horizon=float(t[-1]),
        error_mean=_mean(valid),
        error_std=_variance(valid) ** 0.5,
        error_median=float(valid.quantile(0.5)) if valid.numel() else math.inf,
        error_worst=float(per_trajectory[worst]),
        worst_trajectory=worst,
        squared_error_mean=_mean(valid.square()),
        squared_error_variance=_variance(valid.square()),
        valid_time={
            name: float(torch.where(mask.any(1), t[mask.int().argmax(1)], t[-1]).mean())
            for name, mask in above.items()
        },
    )


def member_metrics(prediction: Prediction) -> dict[str, float]:
    """Return the errors of the E members of an ensemble, and how well their spread tells the error.

    ``spread_over_error`` is sqrt((1 + 1/E) mean(s^2) / mean(e^2)), with the spread s(t) of
    :meth:`Prediction.spread` and the error e(t) of the ensemble: 1 if the truth is distributed
    like the members, below 1 if the ensemble is overconfident. Diverged rollouts of the ensemble
    are left out of the means of s and e.
    Source: Fortin et al. (2014), "Why should ensemble spread match the RMSE of the ensemble mean?"
    """
    valid = ~diverged_trajectories(prediction)
    spread, error = prediction.spread()[valid], prediction.error()[valid]
    assert prediction.members is not None
    errors = [
        rollout_metrics(q_hat, prediction.q, prediction.t, thresholds={}).error_mean
        for q_hat in prediction.members
    ]
    ratio = math.inf
    if 0 < _mean(error.square()) < math.inf:
        ratio = (1 + 1 / len(errors)) * _mean(spread.square()) / _mean(error.square())
    return {
        "members": len(errors),
        "member_error_mean": statistics.fmean(errors),
        "spread_mean": _mean(spread),
        "spread_over_error": ratio**0.5,
    }


def diverged_trajectories(prediction: Prediction) -> Tensor:
    """Return the trajectories that diverged, ``(K,)``, bool.

    A trajectory has diverged if q_hat is not finite anywhere, or if e(t) exceeds 1000 times the
    spread of the true q anywhere. The spread is the root mean square distance of q from its mean,
    over all times and trajectories. If the truth never moves, only the first condition applies.
    """
    q, error = prediction.q, prediction.error()
    spread = (q - q.mean(dim=(0, 1))).square().sum(-1).mean().sqrt()
    bound = DIVERGENCE_FACTOR * float(spread) if spread > 0 else math.inf
    return ~((error <= bound) & torch.isfinite(error)).all(dim=1)


def state_squared_error(prediction: Prediction) -> dict[str, float]:
    """Return mean and variance of the squared error of q and v, as the paper's code prints them::

        e_x(t)^2 = |q_hat(t) - q(t)|^2 + |v_hat(t) - v(t)|^2

    Both are over all times of the rollouts that did not diverge. The dictionary is empty if the
    prediction has no velocities.
    """
    if prediction.v_hat is None or prediction.v is None:
        return {}
    valid = ~diverged_trajectories(prediction)
    of_v = (prediction.v_hat - prediction.v)[valid].square().sum(-1)
    square = prediction.error()[valid].square() + of_v
    return {
        "state_squared_error_mean": _mean(square),
        "state_squared_error_variance": _variance(square),
    }


def left_data(prediction: Prediction, train: Sequence[Trajectory]) -> dict[str, float]:
    """Count the rollouts that leave the data of the training trajectories, q ``(T, N)`` each.

    A rollout has left the data once a predicted coordinate lies below ``low - (high - low)`` or
    above ``high + (high - low)``, with the extremes of all training trajectories, or is not finite.
    ``left_data_after`` is the first time in s at which one leaves, infinite if none does.
    """
    q = torch.cat([item.q for item in train])
    low, high = q.amin(dim=0), q.amax(dim=0)
    width, q_hat = high - low, prediction.q_hat
    inside = ((q_hat >= low - width) & (q_hat <= high + width)).all(dim=-1)
    left = ~inside.all(dim=0)
    first = float(prediction.t[int(left.int().argmax())] - prediction.t[0])
    return {
        "left_data": int((~inside.all(dim=1)).sum()),
        "left_data_after": first if left.any() else math.inf,
    }


def _mean(values: Tensor) -> float:
    return float(values.mean()) if values.numel() else math.inf


def _variance(values: Tensor) -> float:
    return float(values.var(correction=0)) if values.numel() else math.inf
