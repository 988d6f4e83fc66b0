"""Numbers of a log check: noise, regressors, shares of the motion, distances, bandwidth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import welch
from scipy.spatial import cKDTree

from pinn_dyn.data.logs import DelayCurve, Recording
from pinn_dyn.mechanics import Trajectory

_SMOOTH = 0.03  # width of the kernel before a derivative, s
_POINTS = 4000  # of a figure or a search among neighbours
_STILL = 0.01  # of the fastest, a speed below which the robot rests
_NEAR = 0.05  # of the spread


def white_noise(x: np.ndarray) -> np.ndarray:
    """Return the standard deviation of white noise, from third differences.

    A smooth motion has next to no third difference.
    """
    third = np.diff(x, n=3, axis=0)
    return 1.4826 * np.median(np.abs(third), axis=0) / np.sqrt(20)


def regressor_columns(training: list[Recording], step: float) -> np.ndarray:
    """Return columns 1, q, v, a, averaged by a Gaussian kernel and of unit spread."""
    width = max(_SMOOTH / step, 1.5)
    thin = max(1, int(width / 2))
    parts = []
    for item in training:
        if len(item) > 10 * width:
            smooth = [gaussian_filter1d(item.q, width, axis=0, order=k) for k in range(3)]
            inner = slice(int(4 * width), -int(4 * width), thin)
            parts.append(np.hstack([x[inner] for x in smooth]))
    x = np.vstack(parts) if parts else np.zeros((1, 3 * training[0].q.shape[1]))
    x = (x - x.mean(axis=0)) / x.std(axis=0).clip(min=1e-300)
    return np.hstack([np.ones((len(x), 1)), x])


def independent_share(x: np.ndarray, k: int, size: int) -> float:
    """Return the share of a_k that 1, q_k, v_k and the other accelerations do not explain."""
    accelerations = np.arange(1 + 2 * size, 1 + 3 * size)
    column = accelerations[k]
    known = x[:, [0, 1 + k, 1 + size + k, *accelerations[accelerations != column]]]
    remainder = x[:, column] - known @ np.linalg.lstsq(known, x[:, column], rcond=None)[0]
    return float(remainder.var() / max(x[:, column].var(), 1e-300))


def explained_share(training: list[Recording], delays: Sequence[DelayCurve], step: float) -> float:
    """Return the largest share that delayed inputs add to the explanation of v and of a.

    Without inputs, v and a are explained by (1, q, v). The shares are corrected for the number of
    terms. The result is 1 where the rows are too few to tell.
    """
    width = max(_SMOOTH / step, 1.5)
    edge = int(4 * width) + 1
    lags = [round((curve.delay or 0.0) / step) for curve in delays]
    parts = []
    for item in training:
        first = edge + max(lags)
        # At this distance their averages are independent.
        rows = np.arange(first, len(item) - edge, max(1, int(3.5 * width)))
        if not len(rows):
            continue
        motion = [gaussian_filter1d(item.q, width, axis=0, order=k)[rows] for k in range(3)]
        smooth = gaussian_filter1d(item.u, width, axis=0)
        acting = np.column_stack([smooth[rows - lag, i] for i, lag in enumerate(lags)])
        parts.append([*motion, acting])
    if sum(len(q) for q, *_ in parts) < 6 * (3 * training[0].q.shape[1] + len(delays)):
        return 1.0
    position, speed, acceleration, inputs = map(np.vstack, zip(*parts, strict=True))
    known = np.hstack([np.ones((len(position), 1)), position, np.sin(position), np.cos(position)])
    gains = [
        _unexplained(y, x) - _unexplained(y, np.hstack([x, inputs]))
        for y, x in ((speed, known), (acceleration, np.hstack([known, speed])))
    ]
    # The acceleration of a controlled robot may follow from q and v; its torque then does too.
    gains.append(1 - _unexplained(inputs, np.hstack([known, speed, acceleration])))
    return max(gains)


def _unexplained(y: np.ndarray, x: np.ndarray) -> float:
    """Return the share of the variance of y that x leaves, per degree of freedom."""
    spread = y.std(axis=0)
    moving = spread > 1e-12 * np.abs(y).max(axis=0)  # a constant has the spread of rounding
    if not moving.any():
        return 1.0
    left = len(x) - x.shape[1]
    y = (y[:, moving] - y[:, moving].mean(axis=0)) / spread[moving]
    x = x / np.abs(x).max(axis=0).clip(min=1e-300)
    remainder = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float((remainder**2).mean()) * len(x) / left


def share_at_rest(training: list[Recording]) -> float:
    """Return the share of samples in which no coordinate has a hundredth of its top speed."""
    speeds = np.vstack([np.abs(np.diff(item.q, axis=0)) for item in training])
    return float((speeds < _STILL * speeds.max(axis=0).clip(min=1e-300)).all(axis=1).mean())


def bandwidth(training: Sequence[Recording], step: float, noise: np.ndarray) -> float:
    """Return the frequency in Hz below which 99 % of the power of v is, above the noise of q."""
    highest = 0.0
    size = min(round(8 / step), min(len(item) for item in training))
    for k in range(training[0].q.shape[1]):
        powers = [welch(item.q[:, k], 1 / step, nperseg=size)[1] for item in training]
        f = np.fft.rfftfreq(size, step)
        density = np.mean(powers, axis=0)
        # White noise has 2 s² h per Hz; single bad samples have the density of the highest
        # frequencies. Four times that is no noise.
        level = max(2 * noise[k] ** 2 * step, float(np.median(density[len(f) // 2 :])))
        power = np.where(density > 4 * level, density, 0.0) * f**2
        if power.any():
            share = np.cumsum(power) / power.sum()
            highest = max(highest, float(f[int(np.searchsorted(share, 0.99))]))
    return highest


def distance_from(training: list[Recording], test: Sequence[Trajectory]) -> np.ndarray:
    """Return the distance of each test sample (q, v) from the nearest of the training, ``(S,)``.

    The unit is the distance between a tenth of the training and the nine others, so that it does
    not depend on the number of coordinates; at least a twentieth of the spread in each of them,
    which is near also where the training repeats one motion.
    """
    known = np.vstack([np.hstack([item.q, item.v]) for item in training if item.v is not None])
    samples = np.vstack([np.hstack([item.q.numpy(), item.v.numpy()]) for item in test])
    spread = known.std(axis=0).clip(min=1e-300)
    known = known[:: max(1, len(known) // _POINTS)] / spread
    samples = samples[:: max(1, len(samples) // _POINTS)] / spread
    tenth = np.arange(len(known)) * 10 // len(known)
    between = [cKDTree(known[tenth != k]).query(known[tenth == k])[0] for k in range(10)]
    unit = max(float(np.median(np.concatenate(between))), _NEAR * known.shape[1] ** 0.5)
    return cKDTree(known).query(samples)[0] / unit
