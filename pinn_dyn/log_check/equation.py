"""Regression of the equation of motion of a log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

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


@dataclass(frozen=True)
class WeightedFit:
    """Result of S weighted least-squares fits of K columns y to P columns X.

    Attributes:
        theta: coefficients, ``(S, P, K)``.
        weights: weights of the blocks, ``(S, B)``.
        squares: sums of squares of the residual of each block, ``(S, B, K)``.
        totals: sums of squares of y in each block, ``(B, K)``.
    """

    theta: np.ndarray
    weights: np.ndarray
    squares: np.ndarray
    totals: np.ndarray

    def shares(self) -> np.ndarray:
        """Return the part of the mean square of y that X leaves, ``(S, K)``."""
        left = (self.weights[:, :, None] * self.squares).sum(axis=1)
        return (left / (self.weights @ self.totals).clip(min=1e-300)).clip(1e-12, 1)


class EquationOfMotionRegression:
    """Least squares between columns of an equation of motion::

        y = X theta + r,     theta = argmin of sum over blocks b of w_b |y_b - X_b theta|^2

    Every question to a log is a choice of y, X and w. With inverse dynamics, y is a force u(t - d)
    and X holds terms of q, v and a (:func:`terms`, or the regressor of rigid bodies) and of dry
    friction; the delay, a drift of the clock or a saturation is the candidate y with the smallest
    residual, and a coefficient is the dry friction of a joint. With more inputs than coordinates,
    y is v or a.
    Fits need the inner products of columns alone, which are summed once for each block.

    Args:
        columns: columns by name, ``(R,)`` or ``(R, C)``.
        block: block of each row, ``(R,)``.
        rows: weights of the rows, ``(R, 1)``, or None.
    """

    def __init__(
        self,
        columns: Mapping[str, np.ndarray],
        block: np.ndarray,
        rows: np.ndarray | None = None,
    ):
        parts = {name: x.reshape(len(block), -1) for name, x in columns.items()}
        ends = np.cumsum([x.shape[1] for x in parts.values()])
        self.index = {
            name: np.arange(end - x.shape[1], end)
            for (name, x), end in zip(parts.items(), ends, strict=True)
        }
        self.numbers, self.block = np.unique(block, return_inverse=True)
        values = np.hstack(list(parts.values()))
        if rows is not None:
            values = values * rows
        self.scale = np.sqrt((values**2).mean(axis=0)).clip(min=1e-300)
        values = values / self.scale
        self.products = np.stack(
            [x.T @ x for x in (values[self.block == b] for b in range(len(self.numbers)))]
        )

    def jackknife(self) -> np.ndarray:
        """Return weights of the blocks: all, then all without each block, ``(1 + B, B)``."""
        count = len(self.numbers)
        return np.vstack([np.ones(count), 1 - np.eye(count)])

    def fit(self, y: str, x: Sequence[str], weights: np.ndarray | None = None) -> WeightedFit:
        """Fit the columns ``y`` to the columns ``x``, with weights ``(S, B)``; None are ones."""
        weights = np.ones((1, len(self.numbers))) if weights is None else weights
        terms, target = np.concatenate([self.index[name] for name in x]), self.index[y]
        gram = self.products[:, terms[:, None], terms]
        cross, totals = self.products[:, terms[:, None], target], self.products[:, target, target]
        normal = np.tensordot(weights, gram, 1)
        size = np.trace(normal, axis1=1, axis2=2)[:, None, None] / len(terms)
        normal = normal + (_RIDGE * size + 1e-300) * np.eye(len(terms))
        theta = np.linalg.solve(normal, np.tensordot(weights, cross, 1))
        squares = totals - 2 * np.einsum("spk,bpk->sbk", theta, cross)
        squares = squares + np.einsum("spk,sbpk->sbk", theta, gram[None] @ theta[:, None])
        scale = self.scale[target]
        return WeightedFit(
            theta * scale / self.scale[terms][:, None],
            weights,
            squares.clip(min=0) * scale**2,
            totals * scale**2,
        )

    def held_out(self, y: str, x: Sequence[str]) -> np.ndarray:
        """Return the squares of each block that a fit to the other blocks leaves, ``(B, K)``."""
        squares = self.fit(y, x, self.jackknife()[1:]).squares
        blocks = np.arange(len(self.numbers))
        return np.asarray(squares[blocks, blocks])


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
        rich = RICH * count < data.independent_rows() and count < _MOST
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


def bodies(data: Averages, rigid: Regressor | None) -> np.ndarray | None:
    """Return the regressor of rigid bodies at the rows, ``(R, N, P)``, or None without a robot."""
    return None if rigid is None else rigid(data.q, data.v, data.a)


def tenths(data: Averages) -> np.ndarray:
    """Return the number of the tenth of the rows that a row belongs to, ``(R,)``.

    Parts of less than a second depend on each other: short logs have fewer parts, at least three.
    """
    inside = np.diff(data.stretch) == 0
    seconds = np.diff(data.t)[inside].clip(max=0.1).sum()
    groups = int(np.clip(seconds, 3, GROUPS))
    return np.arange(len(data)) * groups // len(data)
