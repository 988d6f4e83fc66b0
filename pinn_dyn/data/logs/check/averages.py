"""Averages of the signals of a log, and their derivatives, for regressions."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from pinn_dyn.data.logs.recording import Recording

PARTS = 8
"""Number of blocks of a run."""
WIDTH = 0.03
"""Width of the kernel for questions that do not depend on its width, s."""
CUT = 4.0
"""Widths of the Gaussian kernel at which it ends."""
_FEW = 3  # inputs up to which their products are terms too
_ROWS = 8_000  # largest number of rows of the regression
_FEWEST = 40  # rows of a run that is compared
_SHORT = 0.005  # width of the kernel of the sign of v, s
_REST = 0.03  # shortest rest, s
_SLOW = 0.02  # speed at rest as a share of a high speed
_STRIBECK = (0.05, 0.2)  # speeds of the fall of friction, as shares of a high speed
_RESTING = 0.1  # largest weight of samples at rest in an average
_LARGE = 10.0  # acceleration over the usual one from which a row counts less
# Variance of the second derivative of white noise that a kernel of one sample averages.
_SECOND = 3 / (8 * np.sqrt(np.pi))


@dataclass(frozen=True)
class Averages:
    """Averages of q, v, a at R rows, and of the inputs at every lag.

    All signals are averaged by one Gaussian kernel g, whose slopes give the derivatives:
    g * a = g'' * q.

    Attributes:
        t: times, ``(R,)``, s.
        q, v, a: ``(R, N)``.
        sign: average of the sign of v, ``(R, N)``.
        slow_sign: averages of the sign of slow v, of which dry friction has more, ``(R, 2N)``.
        moving: joints that move, ``(R, N)``; dry friction at rest is undetermined.
        u: M inputs at each of D lags, ``(R, D, M)``.
        block: block of the row, ``(R,)``: :data:`PARTS` for each run.
        noise: part of the variance of a that is noise, ``(N,)``.
        spread: standard deviation of the inputs before averaging, ``(M,)``.
    """

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    sign: np.ndarray
    slow_sign: np.ndarray
    moving: np.ndarray
    u: np.ndarray
    block: np.ndarray
    noise: np.ndarray
    spread: np.ndarray

    @classmethod
    def of(
        cls,
        recordings: Sequence[Recording],
        step: float,
        width: float = WIDTH,
        lags: Sequence[int] | np.ndarray = (0,),
        spacing: float = 0.25,
    ) -> Averages | None:
        """Return the averages with a kernel of this width in s; None if there are too few rows.

        Args:
            recordings: stretches of one sample time.
            step: sample time, s.
            width: standard deviation of the kernel, s, at least 1.5 samples.
            lags: lags of the inputs in samples, ascending.
            spacing: distance of rows in widths, at least.
        """
        samples = max(width / step, 1.5)
        edge = int(np.ceil(CUT * samples))
        first, end = edge + max(int(lags[-1]), 0), edge - min(int(lags[0]), 0)
        total = sum(max(len(item) - first - end, 0) for item in recordings)
        stride = max(1, int(spacing * samples), -(-total // _ROWS))
        names = list(dict.fromkeys(item.run for item in recordings))
        parts: list[tuple[int, list[np.ndarray]]] = []
        for item in sorted(recordings, key=lambda item: (names.index(item.run), item.t[0])):
            rows = np.arange(first, len(item) - end, stride)
            if len(rows) < 2:
                continue
            motion = [averages(item.q, samples, step, order)[rows] for order in range(3)]
            friction = [averages(x, samples)[rows] for x in signs(item.q, step)]
            u = averages(item.u, samples)[rows[:, None] - np.asarray(lags, dtype=int)]
            parts.append((names.index(item.run), [item.t[rows], *motion, *friction, u]))
        if not parts:
            return None
        columns = [np.concatenate(x) for x in zip(*(x for _, x in parts), strict=True)]
        run = np.concatenate([np.full(len(x[0]), k) for k, x in parts])
        counts = np.bincount(run)
        index = np.concatenate([np.arange(n) for n in counts])
        block = PARTS * run + index * PARTS // counts[run]
        t, q, v, a, sign, slow_sign, still, u = columns
        white = np.max([noise(item.q) for item in recordings], axis=0) / step**2
        share = _SECOND / samples**5 * white**2 / a.var(axis=0).clip(min=1e-300)
        spread = np.concatenate([item.u for item in recordings]).std(axis=0).clip(min=1e-300)
        return cls(t, q, v, a, sign, slow_sign, still < _RESTING, u, block, share, spread)

    def rows(self, mask: np.ndarray) -> Averages:
        """Return the averages at some rows."""
        names = ("t", "q", "v", "a", "sign", "slow_sign", "moving", "u", "block")
        return replace(self, **{name: getattr(self, name)[mask] for name in names})

    def moving_rows(self, i: int, inputs: int) -> np.ndarray:
        """Return the rows in which the joint of input i moves, or any joint, ``(R,)``."""
        square = inputs == self.q.shape[1]
        return self.moving[:, i] if square else np.asarray(self.moving.any(axis=1))

    def long_runs(self) -> Averages:
        """Return the averages of the runs with enough rows to compare them."""
        counts = np.bincount(self.block // PARTS)
        return self.rows(counts[self.block // PARTS] >= _FEWEST)

    def row_weights(self) -> np.ndarray:
        """Return weights ``(R, 1)`` that are small where a is far from usual, as at a jump of q."""
        usual = np.median(np.abs(self.a), axis=0).clip(min=1e-300)
        return (np.abs(self.a) / usual / _LARGE).clip(1, 1e6).max(axis=1, keepdims=True) ** -2


def averages(
    x: np.ndarray, samples: float, step: float = 1.0, order: int = 0, cut: float = CUT
) -> np.ndarray:
    """Return averages of x by a Gaussian kernel of this width, or their slopes of an order."""
    return (
        scipy.ndimage.gaussian_filter1d(x, samples, axis=0, order=order, truncate=cut) / step**order
    )


def white_noise(x: np.ndarray) -> np.ndarray:
    """Return the standard deviation of white noise on smooth motions, from third differences."""
    return 1.4826 * np.median(np.abs(np.diff(x, n=3, axis=0)), axis=0) / np.sqrt(20)


def noise(x: np.ndarray) -> np.ndarray:
    """Return the standard deviation of noise, at least that of the steps of an encoder."""
    steps = np.abs(np.diff(x, axis=0))
    steps[steps < 1e-9 * np.ptp(x, axis=0)] = np.inf
    smallest = steps.min(axis=0, initial=np.inf)
    return np.maximum(white_noise(x), np.where(np.isfinite(smallest), smallest, 0) / np.sqrt(12))


def signs(q: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the smooth sign of v, that of slow v ``(T, 2N)``, and 1 for samples at rest."""
    samples = max(_SHORT / step, 1.5)
    v = averages(q, samples, step, order=1)
    # Deviation of the derivative of white noise that a Gaussian kernel averages.
    spread = noise(q) / step / np.sqrt(4 * np.sqrt(np.pi) * samples**3)
    high = np.percentile(np.abs(v), 95, axis=0)
    slow = np.maximum(_SLOW * high, 3 * spread).clip(min=1e-300)
    shortest = max(round(_REST / step), 3)  # a reversal of v is no rest
    still = scipy.ndimage.binary_opening(np.abs(v) < slow, np.ones((shortest, 1)))
    sign = np.tanh(v / slow)
    falls = [np.exp(-((v / np.maximum(x * high, slow)) ** 2)) for x in _STRIBECK]
    return sign, np.hstack([sign * x for x in falls]), still.astype(float)


def with_products(recording: Recording) -> Recording:
    """Return a recording whose inputs include powers and products of few inputs, to order 3."""
    u = recording.u
    columns = list(u.T)
    for order in (2, 3) if len(columns) <= _FEW else ():
        columns += [np.prod(x, axis=0) for x in itertools.combinations_with_replacement(u.T, order)]
    return replace(recording, u=np.column_stack(columns))
