"""Least-squares regressions behind a delay curve: averages, terms, unexplained shares."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pinn_dyn.data.logs.recording import Recording

BLOCKS = 10
"""Number B of parts of the data that are left out in turn."""
_FEW = 3  # inputs up to which their products are terms too
_ROWS = 8_000  # largest number of rows of the regression
_CUT = 4.0  # width at which the kernel ends

Regressor = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Maps q, v, a ``(R, N)`` to the Y ``(R, N, P)`` of rigid bodies: their torque is Y pi."""


@dataclass(frozen=True)
class Smoothed:
    """Averages of q, v, a at the rows of the regression, and of the inputs at every lag.

    Attributes:
        q, v, a: ``(R, N)``.
        u: M inputs, then products of few inputs, of unit spread, ``(R, D, M + K)``.
        block: tenth of the data that holds the row, ``(R,)``.
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    u: np.ndarray
    block: np.ndarray

    @classmethod
    def average(
        cls, recordings: Sequence[Recording], step: float, width: float, lags: np.ndarray
    ) -> Smoothed | None:
        """Return the averages with a kernel of this width in s; None if there are too few rows."""
        samples = width / step
        edge = int(np.ceil(_CUT * samples))
        first, end = edge + int(lags[-1]), edge - int(lags[0])
        total = sum(max(len(item) - first - end, 0) for item in recordings)
        # Averages a quarter of a width apart are all but the same.
        stride = max(1, int(0.25 * samples), -(-total // _ROWS))
        rows = [np.arange(first, len(item) - end, stride) for item in recordings]
        pairs = [(item, r) for item, r in zip(recordings, rows, strict=True) if len(r) > 1]
        count = sum(len(r) for _, r in pairs)
        if count < 20 * BLOCKS:
            return None

        def smooth(x: np.ndarray, order: int = 0) -> np.ndarray:
            return gaussian_filter1d(x, samples, axis=0, order=order, truncate=_CUT) / step**order

        q, v, a = (np.vstack([smooth(item.q, order)[r] for item, r in pairs]) for order in range(3))
        inputs = np.concatenate([item.u for item in recordings])
        mean, spread = inputs.mean(axis=0), inputs.std(axis=0).clip(min=1e-300)
        u = [smooth(_monomials((x.u - mean) / spread))[r[:, None] - lags] for x, r in pairs]
        return cls(q, v, a, _standard(np.concatenate(u)), np.arange(count) * BLOCKS // count)


def _monomials(u: np.ndarray) -> np.ndarray:
    """Return the inputs, and up to third order the powers and products of few inputs."""
    columns = list(u.T)
    for order in (2, 3) if len(columns) <= _FEW else ():
        columns += [np.prod(x, axis=0) for x in itertools.combinations_with_replacement(u.T, order)]
    return np.column_stack(columns)


def terms(data: Smoothed, form: str) -> np.ndarray:
    """Return the terms that explain the motion in a form apart from the input, ``(R, P)``.

    1, q, q², sin q, cos q; except for increments v, friction, v_i v_j and (for inverse dynamics) a,
    times 1, sin q and cos q as far as the data are enough for so many.
    """
    q, v, a = data.q, data.v, data.a
    trig = np.hstack([np.ones((len(q), 1)), np.sin(q), np.cos(q)])
    parts = [trig, q, q**2]
    if form != "increments":
        i, j = np.triu_indices(q.shape[1])
        parts += [v, np.tanh(10 * v / v.std(axis=0).clip(min=1e-300))]
        inertial = [v[:, i] * v[:, j], *([a] if form == "inverse dynamics" else [])]
        products = [
            (trig[:, :, None] * x[:, None, :]).reshape(len(x), -1) for x in [*inertial, trig[:, 1:]]
        ]
        rich = 12 * sum(x.shape[1] for x in products) < len(q)
        parts += products if rich else inertial
    return np.hstack(parts)


def input_shares(basis: np.ndarray, data: Smoothed, inputs: slice) -> np.ndarray:
    """Return the share of these inputs that known terms leave, ``(B + 1, D, M)``."""
    u = data.u[..., inputs]
    left, squares = _remainders(basis, u.reshape(len(u), -1), data.block)
    shares = np.diagonal(left, axis1=1, axis2=2) / squares
    return shares.reshape(-1, *u.shape[1:]).clip(1e-12, 1)


def rigid_shares(data: Smoothed, rigid: Regressor) -> np.ndarray:
    """Return the share of each input that bodies and friction leave, ``(B + 1, D, N)``."""
    y = rigid(data.q, data.v, data.a)
    friction = np.tanh(10 * data.v / data.v.std(axis=0).clip(min=1e-300))
    shares = []
    for i in range(data.q.shape[1]):
        drive = [data.a[:, i], data.v[:, i], friction[:, i], np.ones(len(y))]
        shares.append(input_shares(np.column_stack([y[:, i], *drive]), data, slice(i, i + 1)))
    return np.concatenate(shares, axis=-1)


def motion_shares(basis: np.ndarray, data: Smoothed, motion: np.ndarray) -> np.ndarray:
    """Return the share of v or a that terms and inputs of one lag leave, ``(B + 1, D, 1)``."""
    _, lags, inputs = data.u.shape
    m = lags * inputs
    x = np.hstack([data.u.reshape(len(data.u), m), _standard(motion)])
    left, squares = _remainders(basis, x, data.block)
    gram = np.einsum("bdidj->bdij", left[:, :m, :m].reshape(-1, lags, inputs, lags, inputs))
    gram = gram + 1e-6 * squares[:, :1, None, None] * np.eye(inputs)
    product = left[:, :m, m:].reshape(len(left), lags, inputs, -1)
    explained = (product * np.linalg.solve(gram, product)).sum(axis=2)
    remainder = np.diagonal(left, axis1=1, axis2=2)[:, None, m:] - explained
    return (remainder / squares[:, None, m:]).mean(axis=2, keepdims=True).clip(1e-12, 1)


def _remainders(
    basis: np.ndarray, x: np.ndarray, block: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return inner products of x without its known part, ``(B + 1, C, C)``, and squares of x."""
    basis = basis / np.sqrt((basis**2).mean(axis=0)).clip(min=1e-300)
    values, vectors = np.linalg.eigh(basis.T @ basis / len(basis))
    large = values > 1e-9 * values[-1]
    basis = basis @ (vectors[:, large] / np.sqrt(values[large]))
    both, k = np.hstack([basis, x]), basis.shape[1]
    blocks = np.stack([y.T @ y for y in (both[block == b] for b in range(BLOCKS))])
    grams = np.concatenate([blocks.sum(axis=0)[None], blocks.sum(axis=0) - blocks])
    ridge = 1e-9 * np.trace(grams[0, :k, :k]) / k * np.eye(k)
    explained = grams[:, k:, :k] @ np.linalg.solve(grams[:, :k, :k] + ridge, grams[:, :k, k:])
    squares = np.diagonal(grams, axis1=1, axis2=2)[:, k:].clip(min=1e-300)
    return grams[:, k:, k:] - explained, squares


def _standard(x: np.ndarray) -> np.ndarray:
    return (x - x.mean(axis=0)) / x.std(axis=0).clip(min=1e-300)
