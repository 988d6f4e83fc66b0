"""Least-squares regressions behind a delay curve: averages, terms, remainders."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pinn_dyn.data.logs.recording import Recording

BLOCKS = 10
"""Number of parts of the data that are left out in turn."""
_FEW = 3  # inputs, of which products are terms too
_ROWS = 8_000  # of the regression, at most
_CUT = 4.0  # the kernel ends at so many widths

Regressor = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Maps q, v, a ``(R, N)`` to the Y ``(R, N, P)`` of rigid bodies: their torque is Y pi."""


@dataclass(frozen=True)
class Smoothed:
    """Averages of q, v, a at the rows of the regression, and of u at every lag before them.

    Attributes:
        q, v, a: ``(R, N)``.
        u: of the inputs and of the products of them that ``powers`` names, ``(R, D, M)``.
        powers: of each input in each of these products.
        block: which tenth of the data a row is in, ``(R,)``.
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    u: np.ndarray
    powers: list[tuple[int, ...]]
    block: np.ndarray

    @classmethod
    def average(
        cls, recordings: Sequence[Recording], step: float, width: float, lags: np.ndarray
    ) -> Smoothed | None:
        edge = int(np.ceil(_CUT * width / step))
        samples = width / step
        first, end = edge + int(lags[-1]), edge - int(lags[0])
        total = sum(max(len(item) - first - end, 0) for item in recordings)
        # Averages a quarter of a width apart are all but the same.
        stride = max(1, int(0.25 * samples), -(-total // _ROWS))
        rows = [np.arange(first, len(item) - end, stride) for item in recordings]
        pairs = [(item, r) for item, r in zip(recordings, rows, strict=True) if len(r) > 1]
        count = sum(len(r) for _, r in pairs)
        if count < 20 * BLOCKS:
            return None

        def smooth(x: np.ndarray, order: int) -> np.ndarray:
            return gaussian_filter1d(x, samples, axis=0, order=order, truncate=_CUT) / step**order

        q, v, a = (np.vstack([smooth(item.q, order)[r] for item, r in pairs]) for order in range(3))
        powers = _powers(recordings[0].u.shape[1])
        centre = np.concatenate([item.u for item in recordings])
        mean, spread = centre.mean(axis=0), centre.std(axis=0).clip(min=1e-300)
        u = np.concatenate(
            [
                smooth(_monomials((item.u - mean) / spread, powers), 0)[r[:, None] - lags]
                for item, r in pairs
            ]
        )
        return cls(q, v, a, u, powers, np.arange(count) * BLOCKS // count)


def terms(data: Smoothed, *, inverse: bool, first_order: bool = False) -> np.ndarray:
    """Return the terms that explain the motion apart from the input, ``(R, P)``.

    1, q, sin q, cos q, v and friction; v_i v_j and (for inverse dynamics) a, times 1, sin q and
    cos q as far as the data are enough for so many.
    """
    q, v, a = data.q, data.v, data.a
    size = q.shape[1]
    ones = np.ones((len(q), 1))
    trig = np.hstack([ones, np.sin(q), np.cos(q)])
    speed = v.std(axis=0).clip(min=1e-300)
    parts = [trig, q, q**2]
    if not first_order:
        i, j = np.triu_indices(size)
        squares = v[:, i] * v[:, j]
        parts += [v, np.tanh(10 * v / speed)]
        inertial = [squares, a] if inverse else [squares]
        several = [_products(trig, x) for x in [*inertial, trig[:, 1:]]]
        rich = sum(x.shape[1] for x in several)
        parts += several if 12 * rich < len(q) else inertial
    return _whitened(np.hstack(parts))


def rigid_shares(data: Smoothed, rigid: Regressor) -> np.ndarray:
    """Return the share of each input that bodies and friction leave, ``(B + 1, D, N)``."""
    y = rigid(data.q, data.v, data.a)
    speed = data.v.std(axis=0).clip(min=1e-300)
    shares = []
    for i in range(data.q.shape[1]):
        v = data.v[:, i]
        drive = np.stack([data.a[:, i], v, np.tanh(10 * v / speed[i]), np.ones_like(v)], axis=1)
        single = replace(data, u=data.u[..., [i]])
        known = _whitened(np.hstack([y[:, i], drive]))
        shares.append(Remainder.fit(known, single, data.a[:, :0]).of_targets())
    return np.concatenate(shares, axis=-1)


def _powers(inputs: int) -> list[tuple[int, ...]]:
    """Return powers of the inputs in B(u): each alone, and of few inputs their products."""
    alone = [tuple(row) for row in np.eye(inputs, dtype=int)]
    if inputs > _FEW:
        return alone
    products = itertools.product(range(4), repeat=inputs)
    return alone + [p for p in products if 2 <= sum(p) <= 3]


def _monomials(u: np.ndarray, powers: list[tuple[int, ...]]) -> np.ndarray:
    return np.column_stack([np.prod(u ** np.array(p), axis=1) for p in powers])


def _products(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return (x[:, :, None] * y[:, None, :]).reshape(len(x), -1)


def _whitened(x: np.ndarray) -> np.ndarray:
    """Return independent columns of unit size that span the same space."""
    x = x / np.sqrt((x**2).mean(axis=0)).clip(min=1e-300)
    values, vectors = np.linalg.eigh(x.T @ x / len(x))
    keep = values > 1e-9 * values[-1]
    return x @ (vectors[:, keep] / np.sqrt(values[keep]))


@dataclass(frozen=True)
class Remainder:
    """Inner products of the remainders of the inputs at every lag and of the motion.

    The known terms are removed. The first of the B + 1 entries is of all data, each of the next
    leaves a tenth of the data out.

    Attributes:
        inner: of the inputs, ``(B + 1, D M, D M)``.
        with_motion: of inputs and motion, ``(B + 1, D M, N)``.
        motion: squares of the motion's remainder, ``(B + 1, N)``.
        squares: of the whole inputs, ``(B + 1, D M)``, and of the whole motion, ``(B + 1, N)``.
        inputs: M.
    """

    inner: np.ndarray
    with_motion: np.ndarray
    motion: np.ndarray
    squares: tuple[np.ndarray, np.ndarray]
    inputs: int

    @classmethod
    def fit(cls, known: np.ndarray, data: Smoothed, target: np.ndarray) -> Remainder:
        u = _standard(data.u.reshape(len(data.u), -1))
        y = _standard(target)
        both = np.hstack([known, u, y])
        blocks = np.stack([x.T @ x for x in (both[data.block == b] for b in range(BLOCKS))])
        grams = np.concatenate([blocks.sum(axis=0)[None], blocks.sum(axis=0) - blocks])
        k, e = known.shape[1], known.shape[1] + u.shape[1]
        ridge = 1e-9 * np.trace(grams[0, :k, :k]) / k * np.eye(k)
        left = grams[:, k:, k:] - grams[:, k:, :k] @ np.linalg.solve(
            grams[:, :k, :k] + ridge, grams[:, :k, k:]
        )
        squares = np.diagonal(grams, axis1=1, axis2=2)
        m = e - k
        return cls(
            left[:, :m, :m],
            left[:, :m, m:],
            np.diagonal(left[:, m:, m:], axis1=1, axis2=2),
            (squares[:, k:e], squares[:, e:]),
            data.u.shape[2],
        )

    def of_targets(self) -> np.ndarray:
        """Return the share of each input that the known terms leave, ``(B + 1, D, M)``."""
        left = np.diagonal(self.inner, axis1=1, axis2=2)
        share = left / self.squares[0].clip(min=1e-300)
        return share.reshape(len(share), -1, self.inputs).clip(1e-12, 1)

    def of_inputs(self, lag: np.ndarray, moved: Sequence[int]) -> np.ndarray:
        """Return the share of the motion that known terms and inputs leave, ``(B + 1, D)``.

        Args:
            lag: candidate of each of the M inputs, ``(M,)``.
            moved: inputs that take every candidate in turn instead.
        """
        lags = self.inner.shape[1] // self.inputs
        at = np.tile(lag, (lags, 1))
        at[:, list(moved)] = np.arange(lags)[:, None]
        rows = at * self.inputs + np.arange(self.inputs)
        ridge = 1e-6 * self.squares[0][:, :1, None, None] * np.eye(self.inputs)
        gram = self.inner[:, rows[:, :, None], rows[:, None, :]] + ridge
        product = self.with_motion[:, rows]
        explained = (product * np.linalg.solve(gram, product)).sum(axis=2)
        left = (self.motion[:, None] - explained) / self.squares[1][:, None].clip(min=1e-300)
        return left.mean(axis=2).clip(1e-12, 1)


def _standard(x: np.ndarray) -> np.ndarray:
    return (x - x.mean(axis=0)) / x.std(axis=0).clip(min=1e-300)
