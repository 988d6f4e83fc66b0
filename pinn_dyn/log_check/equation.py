"""Regression of the equation of motion of a log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pinn_dyn.log_check.averages import Averages

Regressor = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Maps q, v, a ``(R, N)`` to the Y ``(R, N, P)`` of rigid bodies: their torque is Y pi."""
GROUPS = 10
"""Parts of the data that a jackknife leaves out in turn."""
_RIDGE = 1e-9
RICH = 3
"""Smallest number of independent rows for a term of a rich equation."""
_MOST = 400  # terms, for the time that a regression takes


class Fit(NamedTuple):
    """Result of the fits of K columns y to P columns X in B blocks of rows.

    Attributes:
        theta: coefficients of the fit to all blocks, and without each block, ``(1 + B, P, K)``.
        shares: part of the mean square of y that X leaves in each of these fits, ``(1 + B, K)``.
        held_out: sums of squares of each block that the fit without it leaves, ``(B, K)``.
    """

    theta: np.ndarray
    shares: np.ndarray
    held_out: np.ndarray


class EquationOfMotionRegression:
    """Least squares between columns of an equation of motion::

        y = X theta + r,     theta = argmin |y - X theta|^2

    Every question to a log is a choice of y and X. With inverse dynamics, y is a force u(t - d)
    and X holds terms of q, v and a (:func:`terms`, or the regressor of rigid bodies) and of dry
    friction; the delay, a drift of the clock or a saturation is the candidate y with the smallest
    residual, and a coefficient is the dry friction of a joint. With more inputs than coordinates,
    y is v or a.
    Fits need the inner products of columns alone, which are summed once for each block.

    Args:
        columns: columns by name, ``(R,)`` or ``(R, C)``.
        block: block of each row, ``(R,)``.
    """

    def __init__(self, columns: Mapping[str, np.ndarray], block: np.ndarray):
        parts = {name: x.reshape(len(block), -1) for name, x in columns.items()}
        ends = np.cumsum([x.shape[1] for x in parts.values()])
        self.index = {
            name: np.arange(end - x.shape[1], end)
            for (name, x), end in zip(parts.items(), ends, strict=True)
        }
        values = np.hstack(list(parts.values()))
        self.scale = np.sqrt((values**2).mean(axis=0)).clip(min=1e-300)
        values = values / self.scale
        blocks = [values[block == b] for b in np.unique(block)]
        self.products = np.stack([x.T @ x for x in blocks])

    def fit(self, y: str, x: Sequence[str]) -> Fit:
        """Fit the columns ``y`` to the columns ``x``: to all blocks, and without each in turn."""
        count = len(self.products)
        weights = np.vstack([np.ones(count), 1 - np.eye(count)])
        terms, target = np.concatenate([self.index[name] for name in x]), self.index[y]
        gram = self.products[:, terms[:, None], terms]
        cross, totals = self.products[:, terms[:, None], target], self.products[:, target, target]
        normal, right = np.tensordot(weights, gram, 1), np.tensordot(weights, cross, 1)
        size = np.trace(normal, axis1=1, axis2=2)[:, None, None] / len(terms)
        theta = np.linalg.solve(normal + (_RIDGE * size + 1e-300) * np.eye(len(terms)), right)
        total = weights @ totals
        return Fit(
            theta=theta * self.scale[target] / self.scale[terms][:, None],
            shares=(_squares(theta, normal, right, total) / total.clip(min=1e-300)).clip(1e-12, 1),
            held_out=_squares(theta[1:], gram, cross, totals) * self.scale[target] ** 2,
        )


def _squares(
    theta: np.ndarray, gram: np.ndarray, cross: np.ndarray, totals: np.ndarray
) -> np.ndarray:
    """Return the sum of squares of y - X theta from XᵀX, Xᵀy and yᵀy, ``(S, K)``."""
    squares = totals - 2 * (theta * cross).sum(axis=1) + (theta * (gram @ theta)).sum(axis=1)
    return np.asarray(squares.clip(min=0))


def solve(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return theta of least squares with columns x ``(R, P)`` and one or more y."""
    scale = np.sqrt((x**2).mean(axis=0)).clip(min=1e-300)
    x = x / scale
    normal = x.T @ x
    ridge = _RIDGE * np.trace(normal) / len(normal) + 1e-300
    theta = np.linalg.solve(normal + ridge * np.eye(len(normal)), x.T @ y)
    return np.asarray((theta.T / scale).T)


def unexplained(y: np.ndarray, *x: np.ndarray) -> float:
    """Return the mean share of the variance of y that (1, x) leaves, per degree of freedom."""
    columns, y = np.hstack([np.ones((len(y), 1)), *x]), y - y.mean(axis=0)
    squares = ((y - columns @ solve(columns, y)) ** 2).mean(axis=0)
    shares = (squares / (y**2).mean(axis=0).clip(min=1e-300)).clip(1e-12, 1)
    return float(shares.mean()) * len(y) / max(len(y) - columns.shape[1], 1)


def terms(data: Averages, form: str) -> np.ndarray:
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
        count = sum(x.shape[1] for x in products)
        rich = RICH * count < len(data.independent(1.0)) and count < _MOST
        parts += products if rich else inertial
    return np.hstack(parts)


def force_columns(data: Averages, i: int, rigid: np.ndarray | None) -> dict[str, np.ndarray]:
    """Return the columns that explain input i: terms, sign of v, and sign of slow v.

    Args:
        data: the averages.
        i: number of the input.
        rigid: regressor of rigid bodies at the rows, ``(R, N, P)``. Without it, the terms are
            generic, and the signs of all joints count.
    """
    if rigid is None:
        return {
            "terms": terms(data, "inverse dynamics"),
            "sign": data.sign,
            "slow": data.slow_sign,
        }
    size = data.q.shape[1]
    drive = [data.a[:, i], data.v[:, i], np.ones(len(data))]
    return {
        "terms": np.column_stack([rigid[:, i], *drive]),
        "sign": data.sign[:, [i]],
        "slow": data.slow_sign[:, [i, size + i]],
    }


def tenths(data: Averages) -> np.ndarray:
    """Return the number of the tenth of the rows that a row belongs to, ``(R,)``.

    Parts of less than a second depend on each other: short logs have fewer parts, at least three.
    """
    inside = np.diff(data.stretch) == 0
    seconds = np.diff(data.t)[inside].clip(max=0.1).sum()
    groups = int(np.clip(seconds, 3, GROUPS))
    return np.arange(len(data)) * groups // len(data)
