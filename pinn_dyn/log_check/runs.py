"""Comparison of the runs of a log, in windows of half a second, by their common equation of motion.

With at most as many inputs as coordinates, inverse dynamics u_i = f_i(q, v, a). With more inputs,
increments v = f(q) + B u, or the acceleration a = f(q, v) + B u if it leaves less unexplained.
Without inputs, a = f(q, v).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pinn_dyn.data.logs import Columns, Measurement
from pinn_dyn.data.logs.errors import listed
from pinn_dyn.data.logs.measurement import judged
from pinn_dyn.log_check.averages import CUT, Averages
from pinn_dyn.log_check.delay import FEWEST, DelayCurve
from pinn_dyn.log_check.equation import (
    EquationOfMotionRegression,
    Regressor,
    bodies,
    force_columns,
    terms,
)

RESIDUAL = "residual over that of the median window"
"""Name of the measurement that compares the windows of runs."""
HELD = "time in which the joints are held [s]"
"""Name of the measurement of brakes and contacts."""
INERTIA = "share of positive effective inertia"
"""Name of the measurement that judges the sign of an input."""
_WINDOW = 0.5  # s
_WIDTHS, _MOST = 10, 200  # widths in a window, and windows of a log
_FEWEST = 8  # rows of a window
_PER_TERM = 6  # rows at least
_RESIDUAL, _RATIO = 0.3, 3.0  # of an odd window: share of the signal, and of the usual residual
_FAR = 6.0  # residual over the usual one of an odd window among odd neighbors
_OF_WIDTH = 2.0  # residual with a wide kernel over that with a narrow one, of a fault of the log
_REST = 0.1  # shortest rest, s
_ODD = 0.4  # share of odd windows up to which the others tell the right equation
_AGREE, _AGREES = 0.4, 0.1  # share of windows that have to agree on an equation; their weight
_WORSE = 2.0  # residual of an equation over that of another, of a wrong equation
_ACTS = 0.5  # residual without an input over that with it
_UNKNOWN = "is it another payload or unit, or are columns exchanged, reversed or stuck?"
_UNKNOWN_WINDOWS = 4  # odd windows of a run from which an unknown cause is named
_CLEAR = 0.9  # correlation from which a scale is clear
_SCALES = (0.2, 5.0)  # of another load; beyond, another unit
_NOTICEABLE = 0.05  # share of a force from which its inertial part is judged
_SIGN_ROWS = 600  # from which the sign of an input is judged
_FORCES = {"Nm", "N", "A"}  # units of inputs that push their joint forward


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
    """An equation of motion y = X theta of all runs.

    Attributes:
        columns: columns of y and X by name, ``(R, .)``.
        x: names of the columns of X.
        labels: names of the K columns of y.
        window: number of the window of each row, ``(R,)``.
        theta: coefficients, ``(P, K)``.
        weights: weights of the windows, ``(1, B)``, small where they disagree with the others.
        agree: windows that do not, ``(B,)``.
        offset: constant that was subtracted from the forces, ``(K,)``.
        row_weights: weights of the rows, ``(R, 1)``, small at jumps of q.
        of_bodies: X are the terms of rigid bodies.
        resting: rows in which the joint of the input rests, ``(R,)``; None without a joint.
        friction: columns of X that are its dry friction.
    """

    columns: dict[str, np.ndarray]
    x: list[str]
    labels: Sequence[str]
    window: np.ndarray
    theta: np.ndarray
    weights: np.ndarray
    agree: np.ndarray
    offset: np.ndarray
    row_weights: np.ndarray
    of_bodies: bool = False
    resting: np.ndarray | None = None
    friction: Sequence[int] = ()

    def of_windows(self, weights: np.ndarray | None = None) -> np.ndarray:
        """Return the residual of each window as a share of its signal, ``(B, K)``.

        The share is that of the median window if that window has a larger signal. At rest dry
        friction may hold any force up to its level, which does not count.
        """
        theta = self.theta if weights is None else self._fitted(weights)
        left = np.abs(self.columns["y"] - self._terms() @ theta)
        if self.resting is not None:
            at_rest = (left - self.friction_level(theta)).clip(min=0)
            left = np.where(self.resting[:, None], at_rest, left)
        means, signal = (self._means(x) for x in (left, self.columns["y"]))
        usual = np.maximum(np.median(signal, axis=0), 1e-9 * signal.max(axis=0))
        return means / np.maximum(signal, usual.clip(min=1e-300))

    def usual(self) -> np.ndarray:
        """Return the residual of the median window that agrees with the equation, ``(K,)``.

        The joint moves in these windows most of the time, if there are such windows.
        """
        agree = self.agree
        if self.resting is not None:
            moving = np.bincount(self.window, ~self.resting) > np.bincount(self.window) / 2
            agree = moving & agree if (moving & agree).any() else agree
        return np.median(self.of_windows()[agree], axis=0)

    def _means(self, x: np.ndarray) -> np.ndarray:
        """Return the root mean squares of columns in each window, ``(B, K)``."""
        squares = [np.bincount(self.window, column) for column in (self.row_weights * x**2).T]
        return np.sqrt(np.transpose(squares) / np.bincount(self.window)[:, None])

    def friction_level(self, theta: np.ndarray) -> np.ndarray:
        """Return the largest dry friction of the joint with coefficients ``(P, K)``, ``(K,)``."""
        signs = np.abs(self._terms()[:, self.friction]).max(axis=0)
        return np.asarray(signs @ np.abs(theta[self.friction]))

    def dry_friction(self) -> np.ndarray:
        """Return the part of X theta that is dry friction of the own joint, ``(R,)``."""
        rows = list(self.friction)
        return np.asarray(self._terms()[:, rows] @ self.theta[rows, 0])

    def _fitted(self, weights: np.ndarray) -> np.ndarray:
        """Return coefficients for other weights of the windows, ``(1, B)``."""
        rows = self.row_weights * np.sqrt(weights[0][self.window])[:, None]
        rows = rows if self.resting is None else rows * ~self.resting[:, None]
        regression = EquationOfMotionRegression(self.columns, 0 * self.window, rows)
        return np.asarray(regression.fit("y", self.x).theta[0])

    def _terms(self) -> np.ndarray:
        return np.hstack([self.columns[name] for name in self.x])

    def predicted(self) -> tuple[np.ndarray, np.ndarray]:
        """Return y and X theta, ``(R, K)`` each."""
        return self.columns["y"], self._terms() @ self.theta


@dataclass(frozen=True)
class Motion:
    """Averages of a log with the inputs at the times when they act, and its equations of motion.

    Attributes:
        data: averages.
        window: number of the window of each row, ``(R,)``.
        equations: an equation of each input, or of v or a.
        drawn: the equations of rigid bodies, if there is a robot, else the same.
    """

    data: Averages
    window: np.ndarray
    equations: Sequence[Equation]
    drawn: Sequence[Equation]

    def residual(self, weights: Sequence[np.ndarray] | None = None) -> np.ndarray:
        """Return the residual of each window of all equations, ``(B, K)``."""
        used = [x.weights for x in self.equations] if weights is None else weights
        pairs = zip(self.equations, used, strict=True)
        return np.hstack([equation.of_windows(x) for equation, x in pairs])


def windows(data: Averages, width: float) -> np.ndarray:
    """Return the number of the window of each row, ``(R,)``; -1 for rows of short windows."""
    total = sum(item.duration for item in data.recordings)
    length = max(_WINDOW, _WIDTHS * width, total / _MOST)
    numbers = (data.passed / length).astype(int)
    numbers = numbers + data.run * (numbers.max() + 1)
    counts = np.bincount(numbers)
    return np.where(counts[numbers] >= _FEWEST, numbers, -1)


def equations_of_motion(
    data: Averages, q: Columns, u: Columns, width: float, rigid: Regressor | None = None
) -> Motion | None:
    """Return the equations of motion of a log; None if the rows are too few.

    Args:
        data: averages, with the inputs at the times when they act.
        q, u: columns of coordinates and inputs.
        width: width of the widest kernel that is compared, s.
        rigid: regressor of a rigid robot with one input per joint, or None.
    """
    window = windows(data, width)
    data, window = data.rows(window >= 0), window[window >= 0]
    size = len(u.columns)
    if not len(data):
        return None
    equations: list[Equation] = []
    drawn: list[Equation] = []
    if size > len(q.columns):
        inputs = data.u[:, :size]
        inputs = (inputs - inputs.mean(axis=0)) / inputs.std(axis=0).clip(min=1e-300)
        forms = [
            _equation({"terms": terms(data, form), "inputs": inputs}, y, data, window, q.columns)
            for form, y in (("increments", data.v), ("acceleration", data.a))
        ]
        equations = [min(forms, key=lambda x: np.median(x.usual()))]
    elif size:
        regressor = bodies(data, rigid)
        for i in range(size):
            forms = [
                _equation(
                    force_columns(data, i, known),
                    data.u[:, [i]],
                    data,
                    window,
                    [u.columns[i]],
                    joint=i if size == len(q.columns) else None,
                )
                for known in ([None] if regressor is None else [None, regressor])
            ]
            least = [float(x.usual()[0]) for x in forms]
            # Rigid bodies judge motions well that no other run has, unless a force is missing.
            drawn.append(forms[-1])
            best = -1 if least[-1] < _WORSE * least[0] else 0
            equations.append(replace(forms[best], of_bodies=best == -1 and len(forms) > 1))
    else:
        columns = {"terms": terms(data, "acceleration")}
        equations = [_equation(columns, data.a, data, window, q.columns)]
    count = max(sum(x.columns[k].shape[1] for k in x.x) for x in equations)
    if len(data) < _PER_TERM * count:
        return None
    return Motion(data, window, equations, drawn or equations)


def _equation(
    x: dict[str, np.ndarray],
    y: np.ndarray,
    data: Averages,
    window: np.ndarray,
    labels: Sequence[str],
    joint: int | None = None,
) -> Equation:
    offset = np.median(y, axis=0)
    columns = {**x, "y": y - offset, "u": data.u - np.median(data.u, axis=0)}
    row_weights, resting = data.row_weights(), None
    friction: list[int] = []
    if joint is not None and data.moving[:, joint].sum() >= FEWEST:
        resting = ~data.moving[:, joint]
        size = x["terms"].shape[1]
        joints = x["sign"].shape[1]
        own = joint if joints > 1 else 0
        friction = [size + own, size + joints + own, size + 2 * joints + own]
    fitted = row_weights if resting is None else row_weights * ~resting[:, None]
    regression = EquationOfMotionRegression(columns, window, fitted)
    # A run in a larger unit would outweigh all others.
    totals = np.hstack([regression.fit(name, list(x)).totals for name in ("y", "u")])
    base = regression.spreads(totals).clip(min=1).max(axis=1) ** -2.0
    weights = _weights(regression, list(x), base, _late(data, regression.block))
    return Equation(
        columns=columns,
        x=list(x),
        labels=labels,
        window=regression.block,
        theta=regression.fit("y", list(x), weights).theta[0],
        weights=weights,
        agree=weights[0] > _AGREES * base,
        offset=offset,
        row_weights=row_weights,
        resting=resting,
        friction=friction,
    )


def _late(data: Averages, block: np.ndarray) -> np.ndarray:
    """Return the blocks in the later half of their run, ``(B,)``."""
    rows = np.bincount(data.run).clip(min=1)
    late = data.passed > (np.bincount(data.run, data.passed) / rows)[data.run]
    return np.bincount(block, late) > np.bincount(block) / 2


def _weights(
    regression: EquationOfMotionRegression, x: list[str], base: np.ndarray, late: np.ndarray
) -> np.ndarray:
    """Return the weights of the windows from which most windows have the smallest residual.

    The fits start from all windows, and from the earlier and the later half of each run: a payload
    that is picked up in the middle changes half of the windows.
    """
    results = []
    for start in (np.ones(len(base), dtype=bool), ~late, late):
        if start.any():
            weights = regression.robust_weights("y", x, base, start)
            left = regression.residuals(regression.fit("y", x, weights)).max(axis=1)
            results.append((float(np.quantile(left, _AGREE)), weights))
    least, weights = min(results[1:], key=lambda result: result[0], default=results[0])
    return weights if least < results[0][0] / _WORSE else results[0][1]


def check_runs(
    motions: Sequence[Motion | None],
    names: Sequence[str],
    *,
    inverse: bool,
    exact: bool = True,
) -> tuple[list[Measurement], list[Interval]]:
    """Compare the windows of each run with the equation of the others.

    A window is odd if its residual is three times that of the median window, also if the fit
    includes its run, and if it does not grow with the width of the kernel.

    Args:
        motions: equations with kernels of two widths; None if the rows are too few.
        names: names of the runs.
        inverse: the equations are those of forces.
        exact: the equations are not known to be wrong; else windows without a cause do not count.

    Returns:
        Measurements, and the parts of runs that do not fit.
    """
    narrow, wide = motions
    if narrow is None or wide is None:
        return [], []
    labels = [label for x in narrow.equations for label in x.labels]
    numbers, of_wide = np.unique(narrow.window), np.unique(wide.window)
    residual, smooth = narrow.residual(), np.full((len(numbers), len(labels)), np.inf)
    smooth[np.isin(numbers, of_wide)] = wide.residual()[np.isin(of_wide, numbers)]
    usual = np.hstack([x.usual() for x in narrow.equations]).clip(min=_NOTICEABLE / _RATIO)
    rows = narrow.equations[0].window
    runs = narrow.data.run[np.unique(rows, return_index=True)[1]]  # of each window
    limit = _FAR * usual
    if not _follow(np.asarray((residual > limit).any(axis=1)), runs):
        limit = np.maximum(_RATIO * usual, _RESIDUAL)
    odd = (residual > limit) & (smooth < _OF_WIDTH * residual)
    expected = f"below {_RATIO:g}"
    results, parts = [], []
    share = odd.any(axis=1).mean()
    few = share <= _ODD or (share < 1 - _AGREE and _follow(np.asarray(odd.any(axis=1)), runs))
    for k in np.unique(runs) if few else ():
        # A motion that no other run has may be extrapolated badly: include it in the fit.
        included = [np.where(runs == k, 1, x.weights) for x in narrow.equations]
        again = narrow.residual(included)
        least = np.maximum(_RATIO * usual, np.minimum(limit, _RESIDUAL)) / 1.5
        bad = odd & (runs == k)[:, None] & (again > least)
        bad &= _in_a_row(bad)
        if not bad.any():
            continue
        ratios = np.where(bad, residual / usual, 0)
        j = int(ratios.max(axis=0).argmax())
        cause = _cause(narrow, bad.any(axis=1)[rows], j, labels, inverse)
        times = narrow.data.t[bad.any(axis=1)[rows]]
        if not cause and (bad.any(axis=1).sum() < _UNKNOWN_WINDOWS or not exact):
            continue  # a generic equation is no exact one
        text = (
            f"run {names[k]} does not fit the rest of the log from {times[0]:.4g} to "
            f"{times[-1]:.4g} s: the residual of {labels[j]!r} is {ratios[:, j].max():.3g} times "
            f"that of the median window; {cause or _UNKNOWN} Correct or leave out this part"
        )
        results.append(judged(RESIDUAL, names[k], ratios.max(), expected, True, text))
        parts.append(Interval(int(k), float(times[0]), float(times[-1])))
    largest = float((residual / usual).max())
    return results or [judged(RESIDUAL, "all runs", largest, expected, False, "")], parts


def _follow(odd: np.ndarray, runs: np.ndarray) -> bool:
    """Tell whether windows that are odd follow each other more often than by chance."""
    same_run = np.diff(runs) == 0
    switches = np.diff(odd.astype(int))[same_run] != 0
    return len(switches) > 0 and bool(switches.mean() < odd.mean() * (1 - odd.mean()))


def check_rests(
    motions: Sequence[Motion | None], names: Sequence[str]
) -> tuple[list[Measurement], list[Interval]]:
    """Find parts in which all joints rest, although the inputs exceed their dry friction.

    Kernels of two widths must agree on a part.
    """
    narrow, wide = (_held_parts(x) for x in motions)
    parts = [x for x in narrow if any(x.run == y.run and x.meets(y) for y in wide)]
    if not parts:
        return [judged(HELD, "all runs", 0.0, "0", False, "")], []
    first, more = parts[0], f" and {len(parts) - 1} more parts" if len(parts) > 1 else ""
    text = (
        f"run {names[first.run]} from {first.start:.4g} to {first.end:.4g} s{more}: the joints are "
        "held although the inputs would move them: by a brake, an end stop or a contact? Leave out "
        "these parts"
    )
    seconds = sum(x.end - x.start for x in parts)
    return [judged(HELD, names[first.run], seconds, "0", True, text)], parts


def _held_parts(motion: Motion | None) -> list[Interval]:
    """Return rests in which an input exceeds the dry friction at poses of other motions."""
    if motion is None:
        return []
    data = motion.data
    pushed, moving = np.zeros(len(data), dtype=bool), data.moving.any(axis=1)
    for equation in motion.equations:
        count = equation.theta.shape[0]
        if equation.resting is None or (~equation.resting).sum() < _PER_TERM * count:
            return []
        y, explained = equation.predicted()
        left = np.abs(y - explained)[:, 0]
        level = _RATIO / 2 * equation.friction_level(equation.theta)[0]
        pushed |= left > level + _RATIO * np.median(left[moving])
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


def _cause(motion: Motion, rows: np.ndarray, j: int, labels: Sequence[str], inverse: bool) -> str:
    """Return the likely cause in rows whose left side j does not fit; "" if none fits."""
    u = motion.data.u
    inputs = range(u.shape[1])
    pairs = [x.predicted() for x in motion.equations]
    measured, predicted = (np.hstack(x)[rows] for x in zip(*pairs, strict=True))
    for i in inputs[j : j + 1] if inverse else inputs:
        values = u[rows, i]
        if motion.data.moving_rows(i)[rows].mean() < 0.5:
            continue
        if np.ptp(u[:, i]) > 0 and np.isclose(values, np.median(values), 1e-6, 0).mean() > 0.5:
            if not np.median(values):
                return f"input {i + 1} is 0 there although the robot moves: is it moved by hand?"
            return f"input {i + 1} is constant there: is a sensor stuck?"
    name = f"{labels[j]!r}"
    if inverse:
        offset = np.concatenate([x.offset for x in motion.equations])
        pairs = [x.predicted() for x in motion.equations]
        left = np.abs(np.hstack([a - b for a, b in pairs]))
        # The usual residual, and that without input in these rows.
        usual, without = np.median(left, axis=0), np.median(np.abs(predicted + offset), axis=0)
        if without[j] < _RATIO * usual[j] < np.median(left[rows, j]):
            idle = listed(
                x for x, a, b in zip(labels, without, usual, strict=True) if a < _RATIO * b
            )
            return f"the motion is that without input: {idle} do not act there, is the drive off?"
    else:
        x = motion.equations[0]
        effect = x.columns["inputs"][rows] @ x.theta[-x.columns["inputs"].shape[1] :]
        measured, predicted = effect, measured - predicted + effect
        name = f"the effect of the inputs on {labels[j]!r}"
    # The mean of a torque in another unit is far from that of the other runs.
    measured, predicted = (x - x.mean(axis=0) for x in (measured, predicted))
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


def check_signs(
    motion: Motion | None,
    u: Columns,
    curves: Sequence[DelayCurve],
    rigid: Regressor | None = None,
) -> list[Measurement]:
    """Measure the effective inertia and the mean power of each force or torque.

    Both are positive at the joint that the force drives: M(q) is positive definite, and the robot
    dissipates. With fewer forces than coordinates this is the joint whose power fits an energy. A
    dry friction that is clearly negative is a sign error, too.
    """
    if motion is None or not 0 < len(u.columns) <= motion.data.q.shape[1]:
        return []
    if not set(u.units) <= _FORCES:
        return []
    data, n = motion.data, motion.data.q.shape[1]
    directions, square = np.eye(n), n == len(u.columns)
    few = np.arange(len(data)) % max(1, len(data) // _SIGN_ROWS) == 0
    results = []
    for i, (name, equation) in enumerate(zip(u.columns, motion.equations, strict=True)):
        weights = equation.weights[0, equation.window][few]
        power = (data.u[:, [i]] * data.v)[few]
        shares = (weights @ power) / (weights @ np.abs(power)).clip(min=1e-300)
        k = i if square else driven_joint(data, i)
        driven, columns, theta = data, equation.columns, equation.theta[:, 0]
        if not square:  # The accelerations of passive joints follow from that of the driven joint.
            driven = replace(data, a=directions[k] * data.a)
            columns = {**force_columns(driven, i, None), "y": columns["y"]}
            regression = EquationOfMotionRegression(columns, motion.window, data.row_weights())
            theta = regression.fit("y", equation.x, equation.weights).theta[0, :, 0]
        x = np.hstack([columns[key][few] for key in equation.x])
        moved = driven.rows(few)
        moved = replace(moved, a=moved.a + directions[k])
        pushed = force_columns(moved, i, bodies(moved, rigid if equation.of_bodies else None))
        inertia = (np.hstack([pushed[key] for key in equation.x]) - x) @ theta
        left = columns["y"][few, 0] - x @ theta
        smallest = max(2 * np.std(left), _NOTICEABLE * np.std(columns["y"]))
        clear = np.std(inertia * data.a[few, k]) > smallest
        positive = weights @ (inertia > 0) / weights.sum()
        bad = bool(clear and positive < 0.1 and shares[k] < 0.2)
        curve = curves[i] if curves and square else None
        if curve is not None and curve.delay is not None:
            reversed_friction = curve.friction < -0.05 - 4 * curve.friction_spread
            bad = bad or bool(reversed_friction and shares[k] < 0)
        text = (
            f"input {name!r} seems to push backwards: the effective inertia of coordinate {k + 1} "
            f"is {weights @ inertia / weights.sum():.3g} and its mean power "
            f"{weights @ power[:, k] / weights.sum():.3g} W, expected above 0: is it reversed?"
        )
        measured = (INERTIA, name, positive)
        results.append(judged(*measured, "above 0.1 where it is clear", bad, text))
    return results


def driven_joint(data: Averages, i: int) -> int:
    """Return the joint k whose power u_i v_k is that of an energy E(q, v) and friction."""
    data = data.independent(1.0)
    power = data.u[:, [i]] * data.v
    inside = np.diff(data.stretch) == 0
    energies = np.diff(terms(data, "acceleration"), axis=0)
    heats = np.hstack([data.v**2, np.abs(data.v)])
    columns = {
        "terms": np.hstack([energies, heats[1:] + heats[:-1]])[inside],
        "power": (power[1:] + power[:-1])[inside],
    }
    regression = EquationOfMotionRegression(columns, np.zeros(inside.sum(), dtype=int))
    return int(regression.fit("power", ["terms"]).shares()[0].argmin())
