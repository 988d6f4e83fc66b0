"""Roll-out errors: every figure about prediction quality is computed here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pinn_dyn.evaluation.prediction import Prediction
from pinn_dyn.mechanics import Trajectory

DIVERGENCE_FACTOR = 1e3
"""A roll-out has diverged once its error exceeds this many times the spread of the true q."""


@dataclass(frozen=True)
class RolloutMetrics:
    """Errors of K roll-outs, with e(t) = |q_hat(t) - q(t)|_2 in the units of q.

    Means, deviations and the median are over all times, the start included, of the trajectories
    that did not diverge; they are infinite if all did, never NaN.

    Attributes:
        trajectories: K.
        diverged: how many of them diverged, see :func:`diverged_trajectories`.
        horizon: length of the roll-outs, s.
        error_mean, error_std: mean and (population) standard deviation of e.
        error_median: median of e.
        error_worst: largest mean of e over one trajectory; infinite if any diverged.
        worst_trajectory: index of that trajectory, the first that diverged if any did.
        squared_error_mean, squared_error_variance: mean and (population) variance of e^2.
        error_first_half, error_second_half: mean of e over either half of the horizon; the error
            grows with time if the second is larger.
        valid_time: for each named threshold, the first time in s at which e exceeds it, the
            horizon if it never does; mean over all trajectories. A roll-out that broke down
            (NaN throughout) counts as valid for 0 s.
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
    error_first_half: float
    error_second_half: float
    valid_time: dict[str, float]

    def to_dict(self) -> dict[str, float]:
        """All figures in one flat dictionary; thresholds become ``valid_time_<name>``."""
        flat = {name: value for name, value in vars(self).items() if name != "valid_time"}
        return flat | {f"valid_time_{name}": time for name, time in self.valid_time.items()}


def rollout_metrics(
    q_hat: Tensor, q: Tensor, t: Tensor, *, thresholds: dict[str, float]
) -> RolloutMetrics:
    """Errors of predicted against true configurations.

    Args:
        q_hat: predicted configuration, ``(K, T, N)``.
        q: true configuration, ``(K, T, N)``.
        t: times, ``(T,)``, s.
        thresholds: name and value, in the units of q, for each valid prediction time.

    Raises:
        ValueError: on shapes that do not match, or a true configuration that is not finite.
    """
    if q.ndim != 3 or q_hat.shape != q.shape or t.shape != q.shape[1:2]:
        raise ValueError(
            f"q_hat has shape {tuple(q_hat.shape)}, q {tuple(q.shape)} and t {tuple(t.shape)}: "
            "expected (K, T, N) twice and (T,)"
        )
    if not bool(torch.isfinite(q).all()):
        raise ValueError("q has non-finite entries: the true configuration must be finite")
    t = t.double() - t[0].double()
    prediction = Prediction(t, q_hat.double(), q.double())
    error = prediction.error()
    lost = diverged_trajectories(prediction)
    horizon = float(t[-1])

    late = t > horizon / 2
    kept = error[~lost]
    square = kept.square()
    per_trajectory = torch.where(lost, torch.inf, error.mean(dim=1))
    worst = int(per_trajectory.argmax())
    return RolloutMetrics(
        trajectories=q.shape[0],
        diverged=int(lost.sum()),
        horizon=horizon,
        error_mean=_mean(kept),
        error_std=_variance(kept) ** 0.5,
        error_median=float(kept.quantile(0.5)) if kept.numel() else float("inf"),
        error_worst=float(per_trajectory[worst]),
        worst_trajectory=worst,
        squared_error_mean=_mean(square),
        squared_error_variance=_variance(square),
        error_first_half=_mean(kept[:, ~late]),
        error_second_half=_mean(kept[:, late]),
        valid_time={name: _valid_time(error, t, value) for name, value in thresholds.items()},
    )


def member_metrics(prediction: Prediction) -> dict[str, float]:
    """How good the members of an ensemble are alone, and whether their spread tells the error.

    ``members`` E; ``member_error_mean`` and ``member_error_std``, mean and (sample) standard
    deviation over the members of the mean error of each; ``member_diverged``, roll-outs of single
    members that diverged; ``spread_mean``, mean over time of the spread s(t), see
    :meth:`Prediction.spread`; and the calibration::

        spread_over_error = sqrt((1 + 1/E) mean(s^2) / mean(e^2))

    with e the error of the ensemble. It is 1 if the truth lies among the members as if it were one
    of them, and below 1 if the spread promises too much: what all members have in common, such as
    their data, gives no spread. Diverged roll-outs of the ensemble are left out of both means; like
    an error, a figure that is left with nothing is infinite.
    Source: Fortin et al. (2014), "Why should ensemble spread match the RMSE of the ensemble mean?"

    Raises:
        ValueError: if this is not the prediction of an ensemble.
    """
    kept = ~diverged_trajectories(prediction)
    spread, error = prediction.spread()[kept], prediction.error()[kept]
    assert prediction.members is not None
    alone = [
        rollout_metrics(q_hat, prediction.q, prediction.t, thresholds={})
        for q_hat in prediction.members
    ]
    errors = torch.tensor([item.error_mean for item in alone], dtype=torch.float64)
    ratio = float("inf")
    if 0 < _mean(error.square()) < float("inf"):
        ratio = (1 + 1 / len(alone)) * _mean(spread.square()) / _mean(error.square())
    return {
        "members": len(alone),
        "member_error_mean": float(errors.mean()),
        "member_error_std": float(errors.std()) if errors.isfinite().all() else float("inf"),
        "member_diverged": sum(item.diverged for item in alone),
        "spread_mean": _mean(spread),
        "spread_over_error": ratio**0.5,
    }


def diverged_trajectories(prediction: Prediction) -> Tensor:
    """Which trajectories diverged, ``(K,)``, bool.

    A trajectory has diverged if any of its q_hat is not finite, or if e(t) anywhere exceeds 1000
    times the spread of the true q: the root mean square distance of q from its mean, over all
    times and trajectories. A truth that never moves has no spread; then only the first applies.
    """
    q, error = prediction.q, prediction.error()
    spread = (q - q.mean(dim=(0, 1))).square().sum(-1).mean().sqrt()
    bound = DIVERGENCE_FACTOR * float(spread) if spread > 0 else float("inf")
    # A non-finite q_hat gives a non-finite error, which no comparison with <= lets through.
    return ~((error <= bound) & torch.isfinite(error)).all(dim=1)


def state_squared_error(prediction: Prediction) -> dict[str, float]:
    """The squared norm of the error of q and v together, as the paper's code prints it::

        e_x(t)^2 = |q_hat(t) - q(t)|^2 + |v_hat(t) - v(t)|^2

    ``state_squared_error_mean`` and ``state_squared_error_variance``, over all times of the K
    roll-outs that did not diverge; nothing where the prediction has no velocities.
    """
    if prediction.v_hat is None or prediction.v is None:
        return {}
    kept = ~diverged_trajectories(prediction)
    of_v = (prediction.v_hat - prediction.v)[kept].square().sum(-1)
    square = prediction.error()[kept].square() + of_v
    return {
        "state_squared_error_mean": _mean(square),
        "state_squared_error_variance": _variance(square),
    }


def left_data(prediction: Prediction, train: Sequence[Trajectory]) -> dict[str, float]:
    """Where roll-outs leave the data, which no model can know anything about.

    A roll-out has left them once a predicted coordinate lies below ``low - (high - low)`` or above
    ``high + (high - low)``, with low and high its ends over all training trajectories; one that
    is not finite has left them too. ``left_data`` is how many of the K roll-outs did, and
    ``left_data_after`` the time in s at which the first of them did, infinite if none.

    Args:
        prediction: K roll-outs.
        train: the training trajectories, q ``(T, N)`` each.
    """
    low = torch.stack([item.q.amin(dim=0) for item in train]).amin(dim=0)
    high = torch.stack([item.q.amax(dim=0) for item in train]).amax(dim=0)
    width = high - low
    q_hat = prediction.q_hat
    inside = ((q_hat >= low - width) & (q_hat <= high + width)).all(dim=-1)
    left = ~inside.all(dim=0)
    first = float(prediction.t[int(left.int().argmax())] - prediction.t[0])
    return {
        "left_data": int((~inside.all(dim=1)).sum()),
        "left_data_after": first if left.any() else float("inf"),
    }


def _valid_time(error: Tensor, t: Tensor, threshold: float) -> float:
    exceeded = ~(error <= threshold)  # so that NaN exceeds every threshold
    first = exceeded.int().argmax(dim=1)
    return float(torch.where(exceeded.any(dim=1), t[first], t[-1]).mean())


def _mean(values: Tensor) -> float:
    return float(values.mean()) if values.numel() else float("inf")


def _variance(values: Tensor) -> float:
    return float(values.var(correction=0)) if values.numel() else float("inf")
