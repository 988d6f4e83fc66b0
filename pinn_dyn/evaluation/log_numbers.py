"""The numbers of a log's check: noise, regressors, what the inputs explain, distances."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from pinn_dyn.data.logs import DelayCurve, Recording
from pinn_dyn.mechanics import Trajectory

_SMOOTH = 0.03  # width of the kernel before a derivative, s
_POINTS = 4000  # of a figure or a search among neighbours
_STILL = 0.01  # of the fastest, a speed below which the robot rests
_NEAR = 0.05  # of the spread


def white_noise(x: np.ndarray) -> np.ndarray:
    """Standard deviation of white noise: third differences leave nothing of a smooth motion."""
    third = np.diff(x, n=3, axis=0)
    return 1.4826 * np.median(np.abs(third), axis=0) / np.sqrt(20)


def regressor_columns(training: list[Recording], step: float) -> np.ndarray:
    """Columns 1, q, v, a of averages by a Gaussian kernel, of unit spread."""
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


def own_share(x: np.ndarray, k: int, size: int) -> float:
    """Share of a_k that 1, q_k, v_k and the other accelerations do not explain."""
    accelerations = np.arange(1 + 2 * size, 1 + 3 * size)
    own = accelerations[k]
    others = x[:, [0, 1 + k, 1 + size + k, *accelerations[accelerations != own]]]
    rest = x[:, own] - others @ np.linalg.lstsq(others, x[:, own], rcond=None)[0]
    return float(rest.var() / max(x[:, own].var(), 1e-300))


def explained_shares(
    training: list[Recording], delays: list[DelayCurve], step: float
) -> tuple[float, float]:
    """The largest share that delayed inputs add to the explanation of v and of a by (1, q, v).

    Also the share of q that the inputs explain. Corrected for the number of terms; 1 and 0
    where the rows are too few to tell.
    """
    width = max(_SMOOTH / step, 1.5)
    edge = int(4 * width) + 1
    lags = [round((curve.delay or 0.0) / step) for curve in delays]
    parts = []
    for item in training:
        first = edge + max(lags)
        # So far apart that their averages are independent.
        rows = np.arange(first, len(item) - edge, max(1, int(3.5 * width)))
        if not len(rows):
            continue
        motion = [gaussian_filter1d(item.q, width, axis=0, order=k)[rows] for k in range(3)]
        smooth = gaussian_filter1d(item.u, width, axis=0)
        acting = np.column_stack([smooth[rows - lag, i] for i, lag in enumerate(lags)])
        parts.append([*motion, acting])
    if sum(len(q) for q, *_ in parts) < 6 * (3 * training[0].q.shape[1] + len(delays)):
        return 1.0, 0.0
    position, speed, acceleration, inputs = map(np.vstack, zip(*parts, strict=True))
    known = np.hstack([np.ones((len(position), 1)), position, np.sin(position), np.cos(position)])
    gains = [
        _rest_of(y, x) - _rest_of(y, np.hstack([x, inputs]))
        for y, x in ((speed, known), (acceleration, np.hstack([known, speed])))
    ]
    # A controlled robot's acceleration may follow from q and v; its torque then does too.
    gains.append(1 - _rest_of(inputs, np.hstack([known, speed, acceleration])))
    return max(gains), 1 - _rest_of(position, np.hstack([known[:, :1], inputs]))


def _rest_of(y: np.ndarray, x: np.ndarray) -> float:
    """Share of the variance of y that x leaves, per degree of freedom."""
    spread = y.std(axis=0)
    moving = spread > 1e-12 * np.abs(y).max(axis=0)  # a constant has the spread of rounding
    if not moving.any():
        return 1.0
    left = len(x) - x.shape[1]
    y = (y[:, moving] - y[:, moving].mean(axis=0)) / spread[moving]
    x = x / np.abs(x).max(axis=0).clip(min=1e-300)
    rest = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float((rest**2).mean()) * len(x) / left


def share_at_rest(training: list[Recording]) -> float:
    """Share of the samples in which no coordinate moves by a hundredth of its most."""
    speeds = np.vstack([np.abs(np.diff(item.q, axis=0)) for item in training])
    return float((speeds < _STILL * speeds.max(axis=0).clip(min=1e-300)).all(axis=1).mean())


def distance_from(training: list[Recording], test: Sequence[Trajectory]) -> np.ndarray:
    """Of the test's (q, v) from the nearest of the training.

    The unit is the distance that a tenth of the training keeps from the nine others, so that it
    does not depend on the number of coordinates; at least a twentieth of the spread in each of
    them, which is near also where the training repeats one motion.
    """
    known = np.vstack([np.hstack([item.q, item.v]) for item in training if item.v is not None])
    asked = np.vstack([np.hstack([item.q.numpy(), item.v.numpy()]) for item in test])
    spread = known.std(axis=0).clip(min=1e-300)
    known = known[:: max(1, len(known) // _POINTS)] / spread
    asked = asked[:: max(1, len(asked) // _POINTS)] / spread
    tenth = np.arange(len(known)) * 10 // len(known)
    own = [cKDTree(known[tenth != k]).query(known[tenth == k])[0] for k in range(10)]
    unit = max(float(np.median(np.concatenate(own))), _NEAR * known.shape[1] ** 0.5)
    return cKDTree(known).query(asked)[0] / unit
