"""Least-squares regressions behind a delay curve: averages, terms, unexplained shares."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_opening, gaussian_filter1d

from pinn_dyn.data.logs.recording import Recording

BLOCKS = 10
"""Number B of parts of the data that are left out in turn."""
_FEW = 3  # inputs up to which their products are terms too
_ROWS = 8_000  # largest number of rows of the regression
CUT = 4.0
"""Widths of the Gaussian kernel at which it ends."""
_SHORT = 0.005  # width of the kernel of the sign of v, s
_REST = 0.03  # shortest rest, s
_SLOW = 0.02  # speed at rest as a share of a high speed
_STRIBECK = (0.05, 0.2)  # speeds of the fall of friction, as shares of a high speed
_RESTING = 0.1  # largest weight of samples at rest in an average

Regressor = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Maps q, v, a ``(R, N)`` to the Y ``(R, N, P)`` of rigid bodies: their torque is Y pi."""


@dataclass(frozen=True)
class Smoothed:
    """Averages of q, v, a at the rows of the regression, and of the inputs at every lag.

    Attributes:
        q, v, a: ``(R, N)``.
        sign: average of the sign of v, ``(R, N)``.
        stribeck: averages of the sign of slow v, of which dry friction has more, ``(R, 2N)``.
        moving: joints that move, ``(R, N)``; dry friction at rest is undetermined.
        u: M inputs, then products of few inputs, of unit spread, ``(R, D, M + K)``.
        spread: standard deviation of the averages over the one of the inputs, ``(D, M + K)``.
        block: tenth of the data that holds the row, ``(R,)``.
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    sign: np.ndarray
    stribeck: np.ndarray
    moving: np.ndarray
    u: np.ndarray
    spread: np.ndarray
    block: np.ndarray

    @classmethod
    def average(
        cls, recordings: Sequence[Recording], step: float, width: float, lags: np.ndarray
    ) -> Smoothed | None:
        """Return the averages with a kernel of this width in s; None if there are too few rows."""
        samples = width / step
        edge = int(np.ceil(CUT * samples))
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
            return averages(x, samples, step, order)

        q, v, a = (np.vstack([smooth(item.q, order)[r] for item, r in pairs]) for order in range(3))
        friction = [signs(item.q, step) for item, _ in pairs]
        sign, stribeck, still = (
            np.vstack([smooth(x[k])[r] for x, (_, r) in zip(friction, pairs, strict=True)])
            for k in range(3)
        )
        inputs = np.concatenate([item.u for item in recordings])
        mean, spread = inputs.mean(axis=0), inputs.std(axis=0).clip(min=1e-300)
        u = [smooth(_monomials((x.u - mean) / spread))[r[:, None] - lags] for x, r in pairs]
        inputs = np.concatenate(u)
        block = np.arange(count) * BLOCKS // count
        moving, spread = still < _RESTING, inputs.std(axis=0)
        return cls(q, v, a, sign, stribeck, moving, _standard(inputs), spread, block)


def averages(
    x: np.ndarray, samples: float, step: float = 1.0, order: int = 0, cut: float = CUT
) -> np.ndarray:
    """Return averages of x by a Gaussian kernel of this width, or their slopes of an order."""
    return gaussian_filter1d(x, samples, axis=0, order=order, truncate=cut) / step**order


def white_noise(x: np.ndarray) -> np.ndarray:
    """Return the standard deviation of white noise on smooth motions, from third differences."""
    return 1.4826 * np.median(np.abs(np.diff(x, n=3, axis=0)), axis=0) / np.sqrt(20)


def signs(q: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the smooth sign of v, that of slow v ``(T, 2N)``, and 1 for samples at rest."""
    samples = max(_SHORT / step, 1.5)
    v = averages(q, samples, step, order=1)
    # Deviation of the derivative of white noise that a Gaussian kernel averages.
    noise = white_noise(q) / step / np.sqrt(4 * np.sqrt(np.pi) * samples**3)
    high = np.percentile(np.abs(v), 95, axis=0)
    slow = np.maximum(_SLOW * high, 3 * noise).clip(min=1e-300)
    shortest = max(round(_REST / step), 3)  # a reversal of v is no rest
    still = binary_opening(np.abs(v) < slow, np.ones((shortest, 1)))
    sign = np.tanh(v / slow)
    falls = [np.exp(-((v / np.maximum(x * high, slow)) ** 2)) for x in _STRIBECK]
    return sign, np.hstack([sign * x for x in falls]), still.astype(float)


def _monomials(u: np.ndarray) -> np.ndarray:
    """Return the inputs, and up to third order the powers and products of few inputs."""
    columns = list(u.T)
    for order in (2, 3) if len(columns) <= _FEW else ():
        columns += [np.prod(x, axis=0) for x in itertools.combinations_with_replacement(u.T, order)]
    return np.column_stack(columns)


def terms(data: Smoothed, form: str) -> np.ndarray:
    """Return the terms that explain the motion in a form apart from the input, ``(R, P)``.

    1, q, q², sin q, cos q; except for increments v, v_i v_j and (for inverse dynamics) a, times 1,
    sin q and cos q as far as the data are enough for so many; for acceleration dry friction.
    """
    q, v, a = data.q, data.v, data.a
    trig = np.hstack([np.ones((len(q), 1)), np.sin(q), np.cos(q)])
    parts = [trig, q, q**2]
    if form != "increments":
        i, j = np.triu_indices(q.shape[1])
        parts += [v, data.sign] if form == "acceleration" else [v]
        inertial = [v[:, i] * v[:, j], *([a] if form == "inverse dynamics" else [])]
        products = [
            (trig[:, :, None] * x[:, None, :]).reshape(len(x), -1) for x in [*inertial, trig[:, 1:]]
        ]
        rich = 12 * sum(x.shape[1] for x in products) < len(q)
        parts += products if rich else inertial
    return np.hstack(parts)


def input_shares(data: Smoothed, inputs: int, rigid: Regressor | None = None) -> np.ndarray:
    """Return the share of each input that known terms leave, and its friction ``(2, B + 1, D, M)``.

    The terms are dry friction, which may be larger at low speed, and those of inverse dynamics or
    of rigid bodies. The friction is the coefficient of sign(v_i) in units of the spread of u_i, and
    NaN where it is not determined. With an input per joint, only rows count in which it moves.
    """
    lags, size = data.u.shape[1], data.q.shape[1]
    results = np.ones((2, BLOCKS + 1, lags, inputs))
    results[1] = np.nan
    basis = terms(data, "inverse dynamics") if rigid is None else rigid(data.q, data.v, data.a)
    rows, parts = data.moving.all(axis=1), [[i] for i in range(inputs)]
    if inputs != size:
        rows, parts = data.moving.any(axis=1), [[*range(inputs)]]
    elif rigid is None and rows.mean() > 0.5:
        parts = [[*range(inputs)]]
    for part in parts:
        mask = np.asarray(rows if len(parts) == 1 and rigid is None else data.moving[:, part[0]])
        explained, joints = basis, [*range(size)]
        if rigid is not None:
            drive = [data.a[:, part[0]], data.v[:, part[0]], np.ones(len(mask))]
            explained, joints = np.column_stack([basis[:, part[0]], *drive]), part
        u, sign = data.u[mask][..., part], data.sign[mask][:, joints]
        slow = data.stribeck[mask][:, [i + k for k in (0, size) for i in joints]]
        if len(u) < 20 * BLOCKS:
            continue
        m = lags * len(part)
        x = np.hstack([u.reshape(len(u), m), sign, slow])
        left, squares = _remainders(explained[mask], x, np.arange(len(u)) * BLOCKS // len(u))
        gram = left[:, m:, m:] + 1e-9 * len(u) * np.eye(left.shape[1] - m)
        force = np.linalg.solve(gram, left[:, m:, :m])
        remainder = np.diagonal(left, axis1=1, axis2=2)[:, :m] - (force * left[:, m:, :m]).sum(1)
        end = len(joints)  # The level of the friction is that without its rise at low speed.
        force = np.linalg.solve(gram[:, :end, :end], left[:, m : m + end, :m])
        shares = remainder / squares[:, :m]
        results[0][..., part] = shares.reshape(-1, lags, len(part)).clip(1e-12, 1)
        if inputs == size:
            force = force.reshape(len(left), len(joints), lags, len(part))
            for k, i in enumerate(part):
                results[1, ..., i] = force[:, joints.index(i), :, k] * data.spread[:, i]
    return results


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
