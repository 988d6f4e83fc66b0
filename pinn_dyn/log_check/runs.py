"""Comparison of the runs of a log, in windows of half a second, by their common equation of motion.

With an input per joint, inverse dynamics of all joints with one set of constants: of rigid bodies,
or of a chain of unknown bodies where it leaves less than equations of single joints
u_i = f_i(q, v, a). With more inputs, increments v = f(q) + B u, or the acceleration
a = f(q, v) + B u if it leaves less. Without inputs, a = f(q, v).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from pinn_dyn.data.logs import Columns, Measurement
from pinn_dyn.data.logs.errors import listed
from pinn_dyn.data.logs.measurement import judged
from pinn_dyn.log_check.averages import CUT, Averages
from pinn_dyn.log_check.chain import OWN, chain_columns
from pinn_dyn.log_check.delay import FEWEST
from pinn_dyn.log_check.equation import Regressor, force_columns, solve, terms

RESIDUAL = "residual over that of the median window"
"""Name of the measurement that compares the windows of runs."""
HELD = "time in which the joints are held [s]"
"""Name of the measurement of brakes and contacts."""
_WINDOW = 0.5  # s
_WIDTHS, _MOST = 10, 200  # widths in a window, and windows of a log
_FEWEST = 8  # rows of a window
_ROWS = 1500  # of an equation of all joints
_PER_TERM = 6  # rows at least
_ITERATIONS = 7  # of reweighted least squares
_RATIO = 4.0  # residual of an odd window over the usual one
_FLOOR = 0.005  # usual residual of a window as a share of its signal, at least
_FRICTION = 0.05  # the same as a share of the dry friction, whose terms are not exact
_OF_WIDTH = 2.0  # residual with a wide kernel over that with a narrow one, of a fault of the log
_REST = 0.1  # shortest rest, s
_ODD = 0.4  # share of odd windows up to which the others tell the right equation
_AGREE, _AGREES = 0.4, 0.1  # share of windows that have to agree on an equation; their weight
_WORSE = 2.0  # residual of an equation over that of another, of a wrong equation
_UNKNOWN = "is it another payload or unit, or are columns exchanged, reversed or stuck?"
_WHOLE = 0.7  # share of a run that is all of it
_UNKNOWN_WINDOWS = 4  # odd windows in a row from which an unknown cause is named
_CLEAR = 0.9  # correlation from which a scale is clear
_SCALES = (0.2, 5.0)  # of another load; beyond, another unit


class Interval(NamedTuple):
    """A part of a run, by the number of the run, and its times in s."""

    run: int
    start: float
    end: float

    def meets(self, other: Interval) -> bool:
        """Return true if two parts of a run have a time in common."""
        return self.start <= other.end and other.start <= self.end

    def of(self, data: Averages) -> np.ndarray:
        """Return the rows whose averages include this part, ``(R,)``."""
        edge = CUT * data.width
        inside = (data.t > self.start - edge) & (data.t < self.end + edge)
        return np.asarray((data.run == self.run) & inside)


@dataclass(frozen=True)
class Equation:
    """An equation of motion y_k = X_k theta_k of all runs, fitted to the windows that agree.

    Attributes:
        data: averages, with the inputs at the times when they act.
        x, y: columns ``(R, K, P)`` and left sides ``(R, K)``, without their medians.
        labels: names of the left sides.
        window: number of the window of each row, ``(R,)``.
        numbers: numbers of the windows, ``(B,)``, by time: kernels of other widths have the same.
        shared: all left sides have the same theta, as of one robot.
        of_forces: the left sides are forces.
        friction: columns of dry friction of each left side ``(K, F)``, which may hold its joint.
        damping: column of viscous friction of each left side, ``(K, 1)``.
    """

    data: Averages
    x: np.ndarray
    y: np.ndarray
    labels: Sequence[str]
    window: np.ndarray
    numbers: np.ndarray
    shared: bool
    of_forces: bool
    friction: np.ndarray
    damping: np.ndarray

    @cached_property
    def row_weights(self) -> np.ndarray:
        """Weights of the rows, ``(R, 1)``, small at jumps of q."""
        return self.data.row_weights()

    @property
    def of_joints(self) -> bool:
        """True if each left side is the force of a joint."""
        return self.friction.size > 0

    @cached_property
    def resting(self) -> np.ndarray:
        """Rows in which the joint of a left side rests, ``(R, K)``."""
        if not self.of_joints:
            return np.zeros(self.y.shape, dtype=bool)
        return ~self.data.moving & (self.data.moving.sum(axis=0) >= FEWEST)

    @cached_property
    def size(self) -> np.ndarray:
        """Root mean square of each left side in the median window, ``(K,)``."""
        means = self.means(self.y)
        return np.maximum(np.median(means, axis=0), 1e-9 * means.max(axis=0)).clip(min=1e-300)

    def means(self, values: np.ndarray) -> np.ndarray:
        """Return the root mean squares of columns in each window, ``(B, .)``."""
        squares = [np.bincount(self.window, column) for column in (self.row_weights * values**2).T]
        return np.sqrt(np.transpose(squares) / np.bincount(self.window)[:, None])

    def fitted(self, weights: np.ndarray) -> np.ndarray:
        """Return theta ``(K, P)`` for weights of the windows ``(B,)``."""
        rows = self.row_weights * np.sqrt(weights)[self.window, None] * ~self.resting / self.size
        x, y = self.x * rows[:, :, None], self.y * rows
        if self.shared:
            return np.tile(solve(x.reshape(y.size, -1), y.ravel()), (y.shape[1], 1))
        return np.stack([solve(x[:, k], y[:, k]) for k in range(y.shape[1])])

    def residual(self, theta: np.ndarray) -> np.ndarray:
        """Return the residual of each window as a share of its signal, ``(B, K)``.

        The share is that of the median window if that window has a larger signal. At rest dry
        friction may hold any force up to its level, which does not count.
        """
        left = np.abs(self.y - np.einsum("rkp,kp->rk", self.x, theta))
        at_rest = (left - self.friction_level(theta)).clip(min=0)
        left = np.where(self.resting, at_rest, left)
        return self.means(left) / np.maximum(self.means(self.y), self.size)

    def friction_level(self, theta: np.ndarray) -> np.ndarray:
        """Return the largest dry friction of each joint, ``(K,)``."""
        pairs = enumerate(self.friction)
        return np.array(
            [np.abs(self.x[:, k, c]).max(axis=0) @ np.abs(theta[k, c]) for k, c in pairs]
        )

    def part(self, columns: Iterable[np.ndarray]) -> np.ndarray:
        """Return the part of X theta in some columns of each left side, ``(R, K)``."""
        parts = [self.x[:, k, c] @ self.theta[k, c] for k, c in enumerate(columns)]
        return np.stack(parts, axis=1)

    @cached_property
    def base(self) -> np.ndarray:
        """Weights of the windows ``(B,)``, small where a larger unit would outweigh all others."""
        values = np.hstack([self.y, self.data.u - np.median(self.data.u, axis=0)])
        means = self.means(values)
        usual = np.maximum(np.median(means, axis=0), 1e-9 * means.max(axis=0)).clip(min=1e-300)
        return (means / usual).clip(min=1).max(axis=1) ** -2.0

    @cached_property
    def weights(self) -> np.ndarray:
        """Weights of the windows ``(B,)``, small where they disagree with most others.

        The fits start from all windows. If many disagree, they start from the earlier and the later
        half, too: a payload that is picked up in the middle changes half of them.
        """
        passed = np.bincount(self.window, self.data.passed) / np.bincount(self.window)
        late = passed > np.median(passed)
        first = self._robust(np.ones(len(late), dtype=bool))
        worst = self.residual(self.fitted(first)).max(axis=1)
        least = float(np.quantile(worst, _AGREE))
        if (worst > _RATIO * least).mean() < 1 - 2 * _AGREE or not late.any():
            return first
        others = [self._robust(start) for start in (~late, late)]
        left = [self.residual(self.fitted(x)).max(axis=1) for x in others]
        agreed = [float(np.quantile(x, _AGREE)) for x in left]
        k = int(np.argmin(agreed))
        return others[k] if agreed[k] < least / _WORSE else first

    def _robust(self, start: np.ndarray) -> np.ndarray:
        """Return weights by the loss of Geman and McClure (1985), from a mask of windows."""
        weights = start.astype(float)
        for cut in 0.5 ** np.arange(1, _ITERATIONS + 1):
            residual = self.residual(self.fitted(weights * self.base))
            usual = np.median(residual[start], axis=0).clip(min=1e-3)
            worst = (residual / usual).max(axis=1)
            weights = 1 / (1 + (worst / max(2.5, cut * worst.max())) ** 2) ** 2
        return weights * self.base

    @cached_property
    def theta(self) -> np.ndarray:
        """Coefficients, ``(K, P)``."""
        return self.fitted(self.weights)

    def usual(self) -> np.ndarray:
        """Return the residual of the median window that agrees with the equation, ``(K,)``."""
        agree = self.weights > _AGREES * self.base
        values = self.residual(self.theta)[agree]
        least = _FRICTION * self.friction_level(self.theta) / self.size
        return np.maximum(np.median(values, axis=0), least.clip(min=_FLOOR))

    def predicted(self) -> np.ndarray:
        """Return X theta, ``(R, K)``."""
        return np.asarray(np.einsum("rkp,kp->rk", self.x, self.theta))


def windows(data: Averages, width: float) -> np.ndarray:
    """Return the number of the window of each row, ``(R,)``; -1 for rows of short windows."""
    total = sum(item.duration for item in data.recordings)
    length = max(_WINDOW, _WIDTHS * width, total / _MOST)
    numbers = (data.passed / length).astype(int)
    numbers = numbers + data.run * (numbers.max() + 1)
    counts = np.bincount(numbers)
    return np.where(counts[numbers] >= _FEWEST, numbers, -1)


def equation_of_motion(
    data: Averages,
    q: Columns,
    u: Columns,
    width: float,
    bodies: Regressor | None = None,
) -> Equation | None:
    """Return the equation of motion of a log; None if the rows are too few.

    Args:
        data: averages, with the inputs at the times when they act.
        q, u: columns of coordinates and inputs.
        width: width of the widest kernel that is compared, s.
        bodies: regressor of all joints, of a robot with an input per joint, or None.
    """
    window = windows(data, width)
    data, window = data.rows(window >= 0), window[window >= 0]
    n, size, joint = len(q.columns), len(u.columns), np.arange(len(q.columns))[:, None]
    data = replace(data, u=data.u[:, :size])  # no products of inputs
    if not len(data):
        return None
    if size > n or not size:
        return _of_states(data, q, window)
    shared = bodies is not None and size == n
    if bodies is not None and shared:
        thin = np.arange(len(data)) % max(1, len(data) // _ROWS) == 0
        data, window = data.rows(thin), window[thin]
        x = chain_columns(data, bodies)
        first = x.shape[2] - OWN * n + OWN * joint
        friction, damping = first + np.array([4, 5, 6]), first + 3
    else:
        columns = force_columns(data, 0, None)
        friction, damping = columns["terms"].shape[1] + joint + [0, n, 2 * n], 1 + 4 * n + joint
        x = _for_each(np.hstack(list(columns.values())), size)
    if size < n:
        friction = damping = np.zeros((size, 0), dtype=int)
    return _equation(data, x, data.u, u.columns, window, shared, True, friction, damping)


def _equation(
    data: Averages,
    x: np.ndarray,
    y: np.ndarray,
    labels: Sequence[str],
    window: np.ndarray,
    shared: bool,
    of_forces: bool,
    friction: np.ndarray,
    damping: np.ndarray,
) -> Equation | None:
    rows, sides, count = x.shape
    if rows * (sides if shared else 1) < _PER_TERM * count:
        return None
    numbers, window = np.unique(window, return_inverse=True)
    y = y - np.median(y, axis=0)
    return Equation(data, x, y, labels, window, numbers, shared, of_forces, friction, damping)


def _for_each(x: np.ndarray, sides: int) -> np.ndarray:
    """Return columns ``(R, P)`` for each left side, ``(R, K, P)``."""
    return np.broadcast_to(x[:, None], (len(x), sides, x.shape[1]))


def _of_states(data: Averages, q: Columns, window: np.ndarray) -> Equation | None:
    """Return the equation of v or of a, whichever leaves less; of a without inputs."""
    inputs = (data.u - data.u.mean(axis=0)) / data.u.std(axis=0).clip(min=1e-300)
    forms, results = [("increments", data.v), ("acceleration", data.a)], []
    none = np.zeros((len(q.columns), 0), dtype=int)
    for form, y in forms[data.u.shape[1] == 0 :]:
        x = _for_each(np.hstack([terms(data, form), inputs]), y.shape[1])
        equation = _equation(data, x, y, q.columns, window, False, False, none, none)
        results += [] if equation is None else [equation]
    return min(results, key=lambda x: np.median(x.usual()), default=None)


def check_runs(
    narrow: Equation | None, wide: Equation | None, names: Sequence[str], *, exact: bool = True
) -> tuple[list[Measurement], list[Interval]]:
    """Compare the windows of each run with the equation of the others.

    A window is odd if its residual is four times that of the median window, also if the fit
    includes its run, if it does not grow with the width of the kernel, and if the next window is
    odd, too.

    Args:
        narrow, wide: equations with kernels of two widths; None if the rows are too few.
        names: names of the runs.
        exact: the equations are not known to be wrong; else parts without a cause do not count.

    Returns:
        Measurements, and the parts of runs that do not fit.
    """
    if narrow is None or wide is None:
        return [], []
    usual, rows = narrow.usual(), narrow.window
    residual = narrow.residual(narrow.theta)
    odd = residual > _RATIO * usual
    if odd.any():
        both = np.isin(narrow.numbers, wide.numbers)
        smooth = wide.residual(wide.theta)[np.isin(wide.numbers, narrow.numbers)]
        growth = (smooth + 1e-12) / (residual[both] + 1e-12)
        growth = growth if wide.data.width > narrow.data.width else 1 / growth
        odd[both] &= growth < _OF_WIDTH
        odd &= _in_a_row(odd)
    runs = narrow.data.run[np.unique(rows, return_index=True)[1]]  # of each window
    share = odd.any(axis=1).mean()
    results, parts = [], []
    for k in np.unique(runs[odd.any(axis=1)]) if share < 1 - _AGREE else ():
        # A motion that no other run has may be extrapolated badly: include it in the fit.
        theta = narrow.fitted(np.where(runs == k, 1.0, narrow.weights))
        bad = odd & (runs == k)[:, None] & (narrow.residual(theta) > _RATIO / 1.5 * usual)
        bad &= _in_a_row(bad)
        if not bad.any():
            continue
        ratios = np.where(bad, residual / usual, 0)
        j = int(ratios.max(axis=0).argmax())
        all_odd = odd[rows, j] & (narrow.data.run == k)
        cause = _cause(narrow, bad[rows, j], j) or _cause(narrow, all_odd, j)
        times = narrow.data.t[bad[rows, j]]
        if not cause and not (exact and narrow.shared and _certain(narrow, bad, odd)):
            continue
        measurement = judged(
            name=RESIDUAL,
            place=names[k],
            value=ratios.max(),
            expected=f"below {_RATIO:g}",
            bad=True,
            text=f"run {names[k]} does not fit the rest of the log from {times[0]:.4g} to "
            f"{times[-1]:.4g} s: the residual of {narrow.labels[j]!r} is "
            f"{ratios[:, j].max():.3g} times that of the median window; {cause or _UNKNOWN} "
            "Correct or leave out this part",
        )
        results.append(measurement)
        parts.append(Interval(int(k), float(times[0]), float(times[-1])))
    largest = float((residual / usual).max())
    good = judged(RESIDUAL, "all runs", largest, f"below {_RATIO:g}, or no clear cause", False, "")
    return results or [good], parts


def _certain(motion: Equation, bad: np.ndarray, odd: np.ndarray) -> bool:
    """Tell whether four bad windows are in a row, and most odd rows are at poses of others.

    Else a force that depends on the position may explain them, such as that of a hose, unless all
    of the run is bad.
    """
    rows, of_run = (np.isin(motion.window, np.flatnonzero(x.any(axis=1))) for x in (odd, bad))
    run = motion.data.run == motion.data.run[of_run][0]
    low, high = motion.data.q[~rows].min(axis=0), motion.data.q[~rows].max(axis=0)
    usual = ((motion.data.q[rows] >= low) & (motion.data.q[rows] <= high)).all(axis=1)
    in_a_row = scipy.ndimage.binary_opening(bad.any(axis=1), np.ones(_UNKNOWN_WINDOWS))
    return bool(in_a_row.any() and (usual.mean() > 0.5 or of_run[run].mean() > _WHOLE))


def check_rests(
    narrow: Equation | None, wide: Equation | None, names: Sequence[str]
) -> tuple[list[Measurement], list[Interval]]:
    """Find parts in which all joints rest, although the inputs exceed their dry friction.

    Kernels of two widths must agree on a part.
    """
    parts = _held_parts(narrow)
    others = _held_parts(wide) if parts else []
    parts = [x for x in parts if any(x.run == y.run and x.meets(y) for y in others)]
    if not parts:
        return [judged(HELD, "all runs", 0.0, "0", False, "")], []
    first, more = parts[0], f" and {len(parts) - 1} more parts" if len(parts) > 1 else ""
    measurement = judged(
        name=HELD,
        place=names[first.run],
        value=sum(x.end - x.start for x in parts),
        expected="0",
        bad=True,
        text=f"run {names[first.run]} from {first.start:.4g} to {first.end:.4g} s{more}: the "
        "joints are held although the inputs would move them: by a brake, an end stop or a "
        "contact? Leave out these parts",
    )
    return [measurement], parts


def _held_parts(motion: Equation | None) -> list[Interval]:
    """Return rests in which an input exceeds the dry friction at poses of other motions."""
    if motion is None or not motion.of_joints:
        return []
    data, moving = motion.data, motion.data.moving.any(axis=1)
    if (~motion.resting).sum() < _PER_TERM * motion.x.shape[2]:
        return []
    left = np.abs(motion.y - motion.predicted())
    level = _RATIO / 2 * motion.friction_level(motion.theta)
    usual = np.median(left[moving], axis=0)
    pushed = (motion.resting & (left > level + _RATIO * usual)).any(axis=1)
    low, high = data.q[moving].min(axis=0), data.q[moving].max(axis=0)
    pushed &= ~moving & ((data.q >= low) & (data.q <= high)).all(axis=1)
    edges = np.flatnonzero(np.diff(np.r_[False, pushed, False])).reshape(-1, 2)
    parts = [Interval(int(data.run[k]), data.t[k], data.t[last - 1]) for k, last in edges]
    return [x for x in parts if x.end - x.start > _REST]


def _in_a_row(bad: np.ndarray) -> np.ndarray:
    """Return the windows with a bad neighbor, ``(B, K)``: one alone is a contact or a stop."""
    before, after = np.roll(bad, 1, axis=0), np.roll(bad, -1, axis=0)
    before[0] = after[-1] = False
    return before | after


def _cause(motion: Equation, rows: np.ndarray, j: int) -> str:
    """Return the likely cause in rows whose left side j does not fit; "" if none fits."""
    data, labels, inverse = motion.data, motion.labels, motion.of_forces
    inputs = range(data.u.shape[1])
    for i in inputs[j : j + 1] if inverse else inputs:
        values = data.u[rows, i]
        if data.moving_rows(i)[rows].mean() < 0.5:
            continue
        if np.ptp(data.u[:, i]) > 0 and np.isclose(values, np.median(values), 1e-6, 0).mean() > 0.5:
            if not np.median(values):
                return f"input {i + 1} is 0 there although the robot moves: is it moved by hand?"
            return f"input {i + 1} is constant there: is a sensor stuck?"
    measured, predicted = motion.y, motion.predicted()
    name = f"{labels[j]!r}"
    if inverse:
        left = np.abs(measured - predicted)
        # The usual residual, and that without input in these rows.
        usual = np.median(left, axis=0)
        without = np.median(np.abs(predicted + data.u - measured)[rows], axis=0)
        if without[j] < _RATIO * usual[j] < np.median(left[rows, j]):
            idle = listed(
                x for x, a, b in zip(labels, without, usual, strict=True) if a < _RATIO * b
            )
            return f"the motion is that without input: {idle} do not act there, is the drive off?"
        friction = motion.part(np.hstack([motion.friction, motion.damping]))
        forwards = np.abs(measured - predicted + 2 * friction)[rows]
        if (np.median(forwards, axis=0) < np.median(left[rows], axis=0) / _RATIO).all():
            return "its friction pushes forwards there: does the time run backwards?"
    elif not inputs:
        return ""
    else:
        effect = motion.part(np.tile(-1 - np.arange(len(inputs)), (len(labels), 1)))
        measured, predicted = measured - predicted + effect, effect
        name = f"the effect of the inputs on {labels[j]!r}"
    # The mean of a torque in another unit is far from that of the other runs.
    measured, predicted = (x[rows] - x[rows].mean(axis=0) for x in (measured, predicted))
    sizes = (np.linalg.norm(x, axis=0).clip(min=1e-300) for x in (measured, predicted))
    product = measured.T @ predicted
    match = product / np.outer(*sizes)
    scale = product[j, j] / max((predicted[:, j] ** 2).sum(), 1e-300)
    best = int(match[:, j].argmax())
    if inverse and best != j and match[best, j] > max(_CLEAR, abs(match[j, j])):
        return f"{labels[best]!r} fits {labels[j]!r} better: are they exchanged?"
    if abs(match[j, j]) < _CLEAR or _SCALES[0] < scale < _SCALES[1]:
        return ""
    cause = "is its sign reversed" if scale < 0 else "is it in another unit"
    return f"{name} is {scale:.3g} times what the equation of the others predicts: {cause}?"
