"""Calibration of prediction intervals on motions that no model was fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
import torch
from torch import Tensor

from pinn_dyn.evaluation.metrics import diverged_trajectories
from pinn_dyn.evaluation.prediction import Prediction

LEVEL = 0.95
"""Default level of an interval."""
_LEVELS = np.array([0.05, *np.arange(0.1, 0.91, 0.1), LEVEL, 0.99])
_AT = -2  # index of LEVEL in _LEVELS
_SMALLEST = 1e-300  # mean width of members that agree everywhere


@dataclass(frozen=True)
class Calibration:
    """Coverage of intervals of L nominal levels on held-out errors.

    Attributes:
        level: nominal levels, ``(L,)``.
        share: share of the errors within intervals as wide as the members say, ``(L,)``.
        corrected: the same with widths taken from the validation motions, ``(L,)``, or None.
        factor: mean corrected width over that of the members at the 95 % level, or None.
    """

    level: np.ndarray
    share: np.ndarray
    corrected: np.ndarray | None = None
    factor: float | None = None

    @property
    def within(self) -> float:
        """``share`` of the 95 % interval."""
        return float(self.share[_AT])

    @property
    def within_corrected(self) -> float | None:
        """``corrected`` of the 95 % interval."""
        return None if self.corrected is None else float(self.corrected[_AT])


def half_widths(members: int, level: float | np.ndarray = LEVEL) -> np.ndarray:
    """Return the half width of intervals in units of sqrt(1 + 1/E) s, with the spread s.

    It is the quantile of Student's t with E - 1 degrees of freedom. The interval contains the truth
    with the nominal probability if the truth is distributed like the E members.
    """
    return np.asarray(scipy.stats.t.ppf(0.5 + 0.5 * np.asarray(level), members - 1))


def standardized_errors(prediction: Prediction, floor: Tensor | float = 0.0) -> Tensor:
    """Return |q - q_hat| / sqrt((1 + 1/E) s^2 + m^2), ``(K, T - 1, N)``.

    s is the spread of E members and m the ``floor``, ``(N,)``. The start is left out. The result is
    infinite where a rollout diverged, and where the width is zero, but not the error.
    """
    error = (prediction.q - prediction.q_hat).abs()[:, 1:]
    ratio = torch.where(error > 0, error / _widths(prediction, floor), 0.0)
    ratio = ratio.nan_to_num(torch.inf, posinf=torch.inf)
    return torch.where(diverged_trajectories(prediction)[:, None, None], torch.inf, ratio)


def corrected_width(
    validation: Prediction, level: float | np.ndarray = LEVEL
) -> tuple[Tensor, np.ndarray]:
    """Return m ``(N,)`` and c for intervals q_hat +- c sqrt((1 + 1/E) s^2 + m^2).

    m is the median error of a coordinate in the validation: what the members do not know, such as
    measurement noise, also where they agree because a joint sticks. c contains the share ``level``
    of the errors, and is infinite if more rollouts diverge. Source: Lei et al. 2018,
    "Distribution-free predictive inference for regression", sec. 5.2 (locally weighted conformal
    inference).
    """
    error = (validation.q - validation.q_hat).abs()[:, 1:]
    floor = error.flatten(0, 1).nanmedian(dim=0).values
    errors = standardized_errors(validation, floor).flatten().numpy()
    return floor, np.asarray(np.quantile(errors, level, method="higher"))


def calibration(held_out: Prediction, validation: Prediction | None) -> Calibration:
    """Compare nominal levels of intervals with their coverage, over all coordinates and times.

    The interval of level p is q_hat +- c_p sqrt(1 + 1/E) s. According to the members, c_p is the
    quantile of :func:`half_widths`. The corrected interval is that of :func:`corrected_width`.

    Args:
        held_out: rollouts with members, of motions that took no part in training.
        validation: rollouts of the validation motions over the same time, or None.
    """
    assert held_out.members is not None
    errors = standardized_errors(held_out).flatten().numpy()
    width = half_widths(len(held_out.members), _LEVELS)
    share = _within(errors, width)
    if validation is None:
        return Calibration(_LEVELS, share)
    floor, corrected = corrected_width(validation, _LEVELS)
    errors = standardized_errors(held_out, floor).flatten().numpy()
    widths = [_widths(validation, x) for x in (floor, 0.0)]
    means = [float(x[x.isfinite()].mean()) for x in widths]
    factor = corrected[_AT] * means[0] / (width[_AT] * max(means[1], _SMALLEST))
    return Calibration(_LEVELS, share, _within(errors, corrected), float(factor))


def _widths(prediction: Prediction, floor: Tensor | float) -> Tensor:
    """Return sqrt((1 + 1/E) s^2 + m^2), ``(K, T - 1, N)``."""
    assert prediction.members is not None
    variance = prediction.deviation()[:, 1:].square() * (1 + 1 / len(prediction.members))
    return (variance + floor**2).sqrt()


def _within(errors: np.ndarray, width: np.ndarray) -> np.ndarray:
    finite = np.sort(errors[np.isfinite(errors)])
    return np.searchsorted(finite, width, side="right") / max(len(errors), 1)
