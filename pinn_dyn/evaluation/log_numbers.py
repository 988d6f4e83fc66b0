"""Numbers of a log check: noise, share of the inputs, bandwidth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from pinn_dyn.data.logs import DelayCurve, Recording
from pinn_dyn.data.logs.delay_regression import CUT, averages

_LAGS = 30  # of a target that are tried
_STILL = 0.01  # variance of a coordinate at rest as a share of the largest
_SMOOTH = 0.03  # width of the kernel before a derivative, s


def explained_share(
    training: Sequence[Recording], delays: Sequence[DelayCurve], step: float
) -> float:
    """Return the largest share of v and a that delayed inputs explain beside (1, q, v).

    The result is 1 where the rows are too few to tell.
    """
    width = max(_SMOOTH / step, 1.5)
    edge = int(CUT * width) + 1
    lags = [round((curve.delay or 0.0) / step) for curve in delays]
    parts = []
    for item in training:
        # At this distance the averages of two rows are independent.
        rows = np.arange(edge + max(lags), len(item) - edge, max(1, int(3.5 * width)))
        smooth = averages(item.u, width)
        acting = np.column_stack([smooth[rows - lag, i] for i, lag in enumerate(lags)])
        motion = [averages(item.q, width, order=k)[rows] for k in range(3)]
        parts.append([*motion, acting])
    q, v, a, u = map(np.vstack, zip(*parts, strict=True))
    if len(q) < 6 * (3 * q.shape[1] + len(lags)):
        return 1.0
    basis = np.hstack([np.ones((len(q), 1)), q, np.sin(q), np.cos(q)])
    return max(
        _unexplained(v, basis) - _unexplained(v, np.hstack([basis, u])),
        _unexplained(a, np.hstack([basis, v])) - _unexplained(a, np.hstack([basis, v, u])),
        # The acceleration of a controlled robot may follow from q and v; its torque then does too.
        1 - _unexplained(u, np.hstack([basis, v, a])),
    )


def target_distance(training: Sequence[Recording], step: float, longest: float) -> float:
    """Return the share of the variance of q that delayed targets u do not explain.

    The delay of each coordinate is the best one up to ``longest``, s. A constant offset between
    target and q does not count. The result is that of the worst coordinate.
    """
    size = training[0].q.shape[1]
    if training[0].u.shape[1] not in (size, 2 * size):
        return np.inf
    spread = np.vstack([item.q for item in training]).var(axis=0)
    spread = spread.clip(min=max(_STILL * spread.max(), 1e-300))
    lags = range(0, round(longest / step) + 1, max(round(longest / step / _LAGS), 1))
    shares = []
    for lag in lags:
        parts = [item.q[lag:] - item.u[: len(item) - lag, :size] for item in training]
        shares.append(np.vstack(parts).var(axis=0) / spread)
    return float(np.min(shares, axis=0).max())


def _unexplained(y: np.ndarray, x: np.ndarray) -> float:
    """Return the share of the variance of y that x leaves, per degree of freedom."""
    spread = y.std(axis=0)
    moving = spread > 1e-12 * np.abs(y).max(axis=0)  # a constant has the spread of rounding
    if not moving.any():
        return 1.0
    y = (y[:, moving] - y[:, moving].mean(axis=0)) / spread[moving]
    x = x / np.abs(x).max(axis=0).clip(min=1e-300)
    remainder = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float((remainder**2).mean()) * len(x) / (len(x) - x.shape[1])


def bandwidth(training: Sequence[Recording], step: float, noise: np.ndarray) -> float:
    """Return the frequency in Hz below which 99 % of the power of v is, above the noise of q."""
    size = min(round(8 / step), min(len(item) for item in training))
    spectra = [scipy.signal.welch(item.q, 1 / step, nperseg=size, axis=0) for item in training]
    f, density = spectra[0][0], np.mean([power for _, power in spectra], axis=0)
    # White noise has 2 s² h per Hz. Power up to four times this level counts as noise.
    level = np.maximum(2 * noise**2 * step, np.median(density[len(f) // 2 :], axis=0))
    power = np.where(density > 4 * level, density, 0.0) * f[:, None] ** 2
    share = np.cumsum(power, axis=0) / power.sum(axis=0).clip(min=1e-300)
    return max((float(f[np.searchsorted(x, 0.99)]) for x in share.T if x[-1] > 0), default=0.0)
