"""Averages of the signals of a log, and their derivatives, for regressions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view

from pinn_dyn.data.logs import Recording

CUT = 5.0
"""Widths of the kernel at which it ends."""
_WIDTHS = (0.005, 0.0075, 0.011, 0.017, 0.025, 0.038, 0.057, 0.085, 0.13)  # of the kernel, s
_TRIED = 4  # widths
_NOISE, _QUIET = 0.01, 3e-4  # largest parts of the variance of the acceleration that are noise
_FEW = 3  # inputs up to which their products are terms too
_MOST, _PART = 200_000, 20.0  # rows of a log that is checked as a whole; s of a part of others
_ROWS = 3_000  # largest number of rows of the regression
_SPACING = 0.25  # smallest distance of rows in widths
_INDEPENDENT = 2.0  # widths at which the averages of two rows are independent
_SHORT = 0.005  # width of the kernel of the sign of v, s
_REST = 0.03  # shortest rest, s
_SLOW = 0.02  # speed at rest as a share of a high speed
_STRIBECK = (0.05, 0.2)  # speeds of the fall of friction, as shares of a high speed
_RESTING = 0.1  # largest weight of samples at rest in an average
_LARGE = 10.0  # acceleration over the usual one from which a row counts less
# The kernel is this polynomial times a Gaussian: its moments from 1 to 5 are zero.
_FLAT = np.polynomial.Polynomial([15, 0, -10, 0, 1]) / 8


Signs = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Smooth sign of v, that of slow v ``(T, 2N)``, and 1 for samples at rest."""


@dataclass(frozen=True)
class Averages:
    """Averages of q, v and a at R rows, and of the inputs at any time.

    All signals are averaged by one kernel g, whose slopes give the derivatives: g * a = g'' * q.
    The kernel leaves polynomials of degree 5 as they are. A product of averages is then the average
    of the product, up to an error that grows with the sixth power of frequency times width; with a
    Gaussian kernel it is the second.

    Attributes:
        width: standard deviation of the kernel, s.
        t: times, ``(R,)``, s.
        q, v, a: ``(R, N)``.
        u: inputs at the times of the rows, ``(R, M)``.
        sign: average of the sign of v, ``(R, N)``.
        slow_sign: averages of the sign of slow v, of which dry friction has more, ``(R, 2N)``.
        moving: joints that move, ``(R, N)``; dry friction at rest is undetermined.
        run: number of the run, ``(R,)``.
        stretch: number of the recording, ``(R,)``.
        passed: time since the beginning of the run, ``(R,)``, s.
        since, left: time since the first and to the last average of the inputs, ``(R,)``, s.
        noise: largest part of the variance of a that is noise, of joints that move.
        spread: standard deviation of the inputs before averaging, ``(M,)``.
        step: sample time, s.
        recordings: the recordings.
        inputs: times, and averages of the inputs, of recordings by their number.
    """

    width: float
    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    u: np.ndarray
    sign: np.ndarray
    slow_sign: np.ndarray
    moving: np.ndarray
    run: np.ndarray
    stretch: np.ndarray
    passed: np.ndarray
    since: np.ndarray
    left: np.ndarray
    noise: float
    spread: np.ndarray
    step: float
    recordings: Sequence[Recording]
    inputs: Mapping[int, tuple[np.ndarray, np.ndarray]]

    @classmethod
    def of(
        cls,
        recordings: Sequence[Recording],
        step: float,
        width: float,
        friction: Sequence[Signs],
    ) -> Averages | None:
        """Return the averages with a kernel of a width in s; None if there are too few rows.

        Args:
            recordings: stretches of one sample time, in the order of their runs.
            step: sample time, s.
            width: standard deviation of the kernel, s, at least 1.5 samples.
            friction: signs of v of each recording.
        """
        samples = max(width / step, 1.5)
        edge = int(np.ceil(CUT * samples))
        total = sum(max(len(item) - 2 * edge, 0) for item in recordings)
        stride = max(1, int(_SPACING * samples), -(-total // _ROWS))
        names = list(dict.fromkeys(item.run for item in recordings))
        starts = {run: min(x.t[0] for x in recordings if x.run == run) for run in names}
        columns: dict[str, list[np.ndarray]] = {}
        inputs: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        for k, item in enumerate(recordings):
            rows = np.arange(edge, len(item) - edge, stride)
            if len(rows) < 2:
                continue
            sign, slow_sign, still = friction[k]
            t = item.t[edge:-edge]
            u = averages(item.u, samples)[edge:-edge]
            part = {
                "t": item.t[rows],
                "q": _at_rows(item.q, samples, stride),
                "v": _at_rows(item.q, samples, stride, 1) / step,
                "a": _at_rows(item.q, samples, stride, 2) / step**2,
                "u": u[::stride],
                "sign": _at_rows(sign, samples, stride),
                "slow_sign": _at_rows(slow_sign, samples, stride),
                "moving": _at_rows(still, samples, stride) < _RESTING,
                "run": np.full(len(rows), names.index(item.run)),
                "stretch": np.full(len(rows), k),
                "passed": item.t[rows] - starts[item.run],
                "since": item.t[rows] - t[0],
                "left": t[-1] - item.t[rows],
            }
            inputs[k] = t, u
            for name, values in part.items():
                columns.setdefault(name, []).append(values)
        if not inputs:
            return None
        joined: dict[str, Any] = {name: np.concatenate(parts) for name, parts in columns.items()}
        white = np.max([noise(item.q) for item in recordings], axis=0) / step**2
        variance = joined["a"].var(axis=0).clip(min=1e-300)
        moving = joined["moving"].mean(axis=0) > _RESTING
        share = (kernel(samples, 2) ** 2).sum() * white**2 / variance
        spread = np.concatenate([item.u for item in recordings]).std(axis=0).clip(min=1e-300)
        return cls(
            width=samples * step,
            step=step,
            noise=float(share[moving].max(initial=0.0)),
            spread=spread,
            recordings=recordings,
            inputs=inputs,
            **joined,
        )

    def __len__(self) -> int:
        return len(self.t)

    def rows(self, mask: np.ndarray) -> Averages:
        """Return the averages at the rows of a mask, or of numbers."""
        names = (*_OF_ROWS, "run", "stretch", "passed", "since", "left")
        return replace(self, **{name: getattr(self, name)[mask] for name in names})

    def thinned(self, count: int) -> Averages:
        """Return about ``count`` rows at equal distances, or all."""
        return self.rows(np.arange(len(self)) % max(1, len(self) // count) == 0)

    def independent(self, widths: float = _INDEPENDENT) -> Averages:
        """Return rows at a distance of some widths, at which their averages are independent."""
        stride = round(widths * self.width / (self.t[1] - self.t[0]))
        return self.rows(np.arange(len(self)) % max(stride, 1) == 0)

    def input_at(self, i: int, times: np.ndarray) -> np.ndarray:
        """Return the average of input i at other times of the recording of each row, ``(R, K)``."""
        result = np.empty(times.shape)
        for k in np.unique(self.stretch):
            rows = self.stretch == k
            t, u = self.inputs[k]
            result[rows] = np.interp(times[rows], t, u[:, i])
        return result

    def averaged(
        self, function: Callable[[Recording], np.ndarray], delays: Sequence[float] | np.ndarray
    ) -> np.ndarray:
        """Return averages of columns ``(T, K)`` of recordings, late by D delays, ``(R, D, K)``."""
        parts = []
        for k in np.unique(self.stretch):
            item = self.recordings[k]
            times = self.t[self.stretch == k][:, None] - delays
            columns = averages(function(item), self.width / self.step)
            parts.append(np.stack([np.interp(times, item.t, x) for x in columns.T], axis=2))
        return np.concatenate(parts)

    def delayed(self, delays: Sequence[float]) -> Averages:
        """Return the averages whose inputs at t are ``u_i(t - d_i)``."""
        if not any(delays):
            return self
        late = [self.input_at(i, self.t - delay) for i, delay in enumerate(delays)]
        return replace(self, u=np.column_stack(late)).rows(self.since >= max(delays))

    def moving_rows(self, i: int) -> np.ndarray:
        """Return the rows in which the joint of input i moves, or any joint, ``(R,)``."""
        square = self.u.shape[1] == self.q.shape[1]
        return self.moving[:, i] if square else np.asarray(self.moving.any(axis=1))

    def row_weights(self) -> np.ndarray:
        """Return weights ``(R, 1)`` that are small where a is far from usual, as at a jump of q."""
        usual = np.median(np.abs(self.a), axis=0).clip(min=1e-300)
        return (np.abs(self.a) / usual / _LARGE).clip(1, 1e6).max(axis=1, keepdims=True) ** -2


_OF_ROWS = ("t", "q", "v", "a", "u", "sign", "slow_sign", "moving")


def averages_of_widths(recordings: Sequence[Recording], step: float) -> list[Averages]:
    """Return averages with kernels of a few widths, from the first that leaves little noise in a.

    If all of them leave much, the result is that of the widest one. It is empty if the recordings
    are too short.
    """
    results: list[Averages] = []
    friction = [signs(item.q, step) for item in recordings]
    for width in sorted({max(width, 1.5 * step) for width in _WIDTHS}):
        data = Averages.of(recordings, step, width, friction)
        if data is None:
            break
        if data.noise > _NOISE or (results and results[0].noise > _NOISE):
            results = []
        results.append(data)
        if len(results) == _TRIED:
            break
    return results


def compared(widths: Sequence[Averages]) -> tuple[int, int]:
    """Return the numbers of the first width with next to no noise in a, and of a neighbor.

    A verdict holds if it is the same with both.
    """
    smooth = (k for k, data in enumerate(widths) if data.noise < _QUIET)
    first = next(smooth, len(widths) - 1)
    return first, first + 1 if first + 1 < len(widths) else max(first - 1, 0)


def averages(x: np.ndarray, samples: float, step: float = 1.0, order: int = 0) -> np.ndarray:
    """Return averages of x by the kernel of a width in samples, or their slopes of an order."""
    weights = kernel(samples, order) / step**order
    return np.asarray(scipy.ndimage.convolve1d(x, weights, axis=0, mode="nearest"))


def _at_rows(x: np.ndarray, samples: float, stride: int, order: int = 0) -> np.ndarray:
    """Return averages of x, or their slopes per sample, at every ``stride``-th row."""
    weights = kernel(samples, order)[::-1]
    parts = sliding_window_view(x, len(weights), axis=0)[::stride]
    return np.asarray(np.einsum("rkt,t->rk", parts, weights))


@cache
def kernel(samples: float, order: int) -> np.ndarray:
    """Return the weights of the kernel, or of its slopes, exact for polynomials of their order."""
    radius = int(np.ceil(CUT * samples))
    t = np.arange(-radius, radius + 1)
    polynomial = _FLAT
    for _ in range(order):
        polynomial = polynomial.deriv() - np.polynomial.Polynomial([0, 1]) * polynomial
    weights = polynomial(t / samples) * np.exp(-((t / samples) ** 2) / 2)
    if order:
        weights -= weights.mean()
    moment = (weights * (-t) ** order).sum() / math.factorial(order)
    return np.asarray(weights / moment)


def white_noise(x: np.ndarray) -> np.ndarray:
    """Return the standard deviation of white noise on smooth motions, from third differences."""
    return 1.4826 * np.median(np.abs(np.diff(x, n=3, axis=0)), axis=0) / np.sqrt(20)


def noise(x: np.ndarray) -> np.ndarray:
    """Return the standard deviation of noise, at least that of the steps of an encoder."""
    steps = np.abs(np.diff(x, axis=0))
    steps[steps < 1e-9 * np.ptp(x, axis=0)] = np.inf
    smallest = steps.min(axis=0, initial=np.inf)
    return np.maximum(white_noise(x), np.where(np.isfinite(smallest), smallest, 0) / np.sqrt(12))


def signs(q: np.ndarray, step: float) -> Signs:
    """Return the signs of the speed of coordinates ``(T, N)``."""
    samples = max(_SHORT / step, 1.5)
    v = scipy.ndimage.gaussian_filter1d(q, samples, axis=0, order=1) / step
    # Deviation of the derivative of white noise that a Gaussian kernel averages.
    spread = noise(q) / step / np.sqrt(4 * np.sqrt(np.pi) * samples**3)
    high = np.percentile(np.abs(v), 95, axis=0)
    slow = np.maximum(_SLOW * high, 3 * spread).clip(min=1e-300)
    shortest = max(round(_REST / step), 3)  # a reversal of v is no rest
    still = scipy.ndimage.binary_opening(np.abs(v) < slow, np.ones((shortest, 1)))
    sign = np.tanh(v / slow)
    falls = [np.exp(-((v / np.maximum(x * high, slow)) ** 2)) for x in _STRIBECK]
    return sign, np.hstack([sign * x for x in falls]), still.astype(float)


def parts_of(recordings: Sequence[Recording], step: float) -> list[Recording]:
    """Return the recordings; of more than 200,000 rows parts of 20 s at equal distances."""
    stride = -(-sum(map(len, recordings)) // _MOST)
    if stride <= 1:
        return list(recordings)
    rows = round(_PART / step)
    parts = [
        item.rows(slice(first, first + rows))
        for item in recordings
        for first in range(0, len(item), rows)
    ]
    return parts[::stride]


def with_products(recording: Recording) -> Recording:
    """Return a recording whose inputs include powers and products of few inputs, to order 3."""
    u = recording.u
    columns = list(u.T)
    for order in (2, 3) if len(columns) <= _FEW else ():
        columns += [np.prod(x, axis=0) for x in itertools.combinations_with_replacement(u.T, order)]
    return replace(recording, u=np.column_stack(columns))
