"""Comparison of the runs of a log by their common equation of motion.

With at most as many inputs as coordinates, inverse dynamics u_i = f_i(q, v, a). With more inputs,
increments v = f(q) + B u, or the acceleration a = f(q, v) + B u if it leaves less unexplained.
Without inputs, a = f(q, v).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pinn_dyn.data.logs.check.averages import PARTS, Averages
from pinn_dyn.data.logs.check.delay import DelayCurve, clear_delays, force_columns
from pinn_dyn.data.logs.check.equation import EquationOfMotionRegression, Regressor, terms
from pinn_dyn.data.logs.check.input_faults import delayed
from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.data.logs.recording import Recording

RESIDUAL = "residual over that of the median run"
"""Name of the measurement that compares runs."""
INERTIA = "share of positive effective inertia"
"""Name of the measurement that judges the sign of an input."""
_PER_TERM = 6  # rows at least
_RESIDUAL, _RATIO = 0.3, 3.0  # of a bad run: share of the signal, and of the median run's residual
_CLEAR = 0.9  # correlation from which a scale is clear
_SCALES = (0.55, 1.8)  # of another load; beyond, another unit
_NOTICEABLE = 0.05  # share of a force from which its inertial part is judged
_FORCES = {"Nm", "N", "A"}  # units of inputs that push their joint forward


@dataclass(frozen=True)
class Equation:
    """An equation of motion y = X theta of all runs.

    Attributes:
        columns: columns of y and X by name, ``(R, .)``.
        x: names of the columns of X.
        labels: names of the K columns of y.
        regression: sums over the blocks of the runs.
        weights: weights of the blocks, ``(1, B)``, small where they disagree with the others.
    """

    columns: dict[str, np.ndarray]
    x: list[str]
    labels: Sequence[str]
    regression: EquationOfMotionRegression
    weights: np.ndarray

    def of_runs(self, weights: np.ndarray | None = None) -> np.ndarray:
        """Return the residual of each run, that of its second worst block, ``(runs, K)``."""
        fit = self.regression.fit("y", self.x, self.weights if weights is None else weights)
        residual = self.regression.residuals(fit)
        run = self.regression.numbers // PARTS
        runs = [np.sort(residual[run == k], axis=0) for k in np.unique(run)]
        return np.array([x[max(len(x) - 2, 0)] for x in runs])

    def predicted(self) -> tuple[np.ndarray, np.ndarray]:
        """Return y and X theta, ``(R, K)`` each."""
        theta = self.regression.fit("y", self.x, self.weights).theta[0]
        return self.columns["y"], np.hstack([self.columns[name] for name in self.x]) @ theta


def equations_of_motion(
    recordings: Sequence[Recording],
    q: Columns,
    u: Columns,
    step: float,
    *,
    curves: Sequence[DelayCurve] = (),
    rigid: Regressor | None = None,
) -> tuple[Averages | None, list[Equation]]:
    """Return averages of a log and its equations of motion; none if the rows are too few.

    Args:
        recordings: stretches of all runs.
        q, u: columns of coordinates and inputs.
        step: sample time, s.
        curves: delays of the inputs, which are corrected before.
        rigid: regressor of a rigid robot with one input per joint, or None.
    """
    size = len(u.columns)
    parts = [replace(x, u=x.u[:, :size]) for x in recordings]
    parts = delayed(parts, clear_delays(curves, step)) if curves else parts
    data = Averages.of(parts, step, spacing=1.0)
    if data is None or not len((data := data.long_runs()).t):
        return None, []
    if size > len(q.columns):
        inputs = data.u[:, 0]
        inputs = (inputs - inputs.mean(axis=0)) / inputs.std(axis=0).clip(min=1e-300)
        forms = [
            _equation({"terms": terms(data, form), "inputs": inputs}, y, data, q.columns)
            for form, y in (("increments", data.v), ("acceleration", data.a))
        ]
        equations = [min(forms, key=lambda x: np.median(x.of_runs()))]
    elif size:
        equations = [
            _equation(force_columns(data, i, rigid), data.u[:, 0, [i]], data, [u.columns[i]])
            for i in range(size)
        ]
    else:
        equations = [_equation({"terms": terms(data, "acceleration")}, data.a, data, q.columns)]
    count = max(sum(x.columns[k].shape[1] for k in x.x) for x in equations)
    return data, equations if len(data.t) >= _PER_TERM * count else []


def check_runs(
    recordings: Sequence[Recording],
    q: Columns,
    u: Columns,
    data: Averages | None,
    equations: Sequence[Equation],
    *,
    curves: Sequence[DelayCurve] = (),
    rigid: Regressor | None = None,
) -> list[Measurement]:
    """Compare each run with the equation of the others, and measure the signs of the forces.

    Fewer than three runs, or too few rows for the terms, are not compared. ``data`` and
    ``equations`` are those of :func:`equations_of_motion` for the other arguments.
    """
    if data is None or not equations:
        return []
    results, inverse = [], len(u.columns) <= len(q.columns)
    if len(np.unique(data.block // PARTS)) >= 3:
        names = list(dict.fromkeys(x.run for x in recordings))
        results = _bad_runs(equations, data, names, inverse)
    forces = inverse and bool(u.columns) and set(u.units) <= _FORCES
    return [*results, *(_signs(equations, data, u, curves, rigid) if forces else [])]


def _equation(
    x: dict[str, np.ndarray], y: np.ndarray, data: Averages, labels: Sequence[str]
) -> Equation:
    columns = {**x, "y": y - np.median(y, axis=0), "u": data.u[:, 0] - np.median(data.u[:, 0], 0)}
    regression = EquationOfMotionRegression(columns, data.block, data.row_weights())
    # A run in a larger unit would outweigh all others.
    totals = np.hstack([regression.fit(name, list(x)).totals for name in ("y", "u")])
    base = regression.spreads(totals).clip(min=1).max(axis=1) ** -2.0
    weights = regression.robust_weights("y", list(x), base)
    return Equation(columns, list(x), labels, regression, weights)


def _bad_runs(
    equations: Sequence[Equation], data: Averages, names: Sequence[str], inverse: bool
) -> list[Measurement]:
    run = np.unique(data.block // PARTS)
    labels = [label for x in equations for label in x.labels]
    residual = np.hstack([x.of_runs() for x in equations])
    usual = np.median(residual, axis=0).clip(min=1e-3)
    ratios = residual / usual
    suspects = np.flatnonzero(((residual > _RESIDUAL) & (ratios > _RATIO)).any(axis=1))
    name, expected = RESIDUAL, f"below {_RATIO:g}"
    results = []
    for k in suspects if len(suspects) <= len(run) // 3 else ():
        # A motion that no other run has may be extrapolated badly: include it in the fit.
        included = [
            x.of_runs(np.where(x.regression.numbers // PARTS == run[k], 1, x.weights))[k]
            for x in equations
        ]
        again = np.concatenate(included)
        bad = (again > _RESIDUAL) & (again > _RATIO / 1.5 * usual)
        if not bad.any():
            continue
        j = int((bad * ratios[k]).argmax())
        rows = _odd_rows(equations, data, j, run[k], usual[j])
        text = (
            f"run {names[run[k]]} does not fit the other runs from {data.t[rows][0]:.4g} to "
            f"{data.t[rows][-1]:.4g} s: the residual of {labels[j]!r} is {ratios[k, j]:.3g} times "
            f"that of the median run; {_cause(equations, data, rows, j, labels, inverse)} Correct "
            "or leave out the run: all numbers of the check include it"
        )
        results.append(judged(name, names[run[k]], ratios[k, j], expected, True, text))
    worst = int(ratios.max(axis=1).argmax())
    return results or [judged(name, names[run[worst]], ratios[worst].max(), expected, False, "")]


def _odd_rows(
    equations: Sequence[Equation], data: Averages, j: int, run: int, usual: float
) -> np.ndarray:
    """Return the rows of a run in the blocks that do not fit, ``(R,)``."""
    residual = np.hstack(
        [x.regression.residuals(x.regression.fit("y", x.x, x.weights)) for x in equations]
    )[:, j]
    odd = residual > max(_RESIDUAL, 2 * usual) / 1.5
    return (data.block // PARTS == run) & odd[equations[0].regression.block]


def _cause(
    equations: Sequence[Equation],
    data: Averages,
    rows: np.ndarray,
    j: int,
    labels: Sequence[str],
    inverse: bool,
) -> str:
    """Return the likely cause in rows whose left side j does not fit."""
    u = data.u[:, 0]
    inputs = range(u.shape[1])
    for i in inputs[j : j + 1] if inverse else inputs:
        values = u[rows, i]
        if np.ptp(u[:, i]) > 0 and np.isclose(values, np.median(values), 1e-6, 0).mean() > 0.5:
            return f"input {i + 1} is constant there: is a sensor stuck?"
    pairs = [x.predicted() for x in equations]
    measured, predicted = (np.hstack(x)[rows] for x in zip(*pairs, strict=True))
    name = f"{labels[j]!r}"
    if not inverse:
        x = equations[0]
        theta = x.regression.fit("y", x.x, x.weights).theta[0]
        effect = x.columns["inputs"][rows] @ theta[-u.shape[1] :]
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
    if abs(match[j, j]) > _CLEAR and not _SCALES[0] < scale < _SCALES[1]:
        cause = "is its sign reversed" if scale < 0 else "is it in another unit"
        return f"{name} is {scale:.3g} times what the other runs predict: {cause}?"
    return "is it another payload, or are columns exchanged, reversed or stuck?"


def _signs(
    equations: Sequence[Equation],
    data: Averages,
    u: Columns,
    curves: Sequence[DelayCurve],
    rigid: Regressor | None,
) -> list[Measurement]:
    """Measure the effective inertia and the mean power of each force or torque.

    Both are positive at the joint that the force drives: M(q) is positive definite, and the robot
    dissipates. With fewer forces than coordinates this is the joint whose power fits an energy. A
    dry friction that is clearly negative is a sign error, too.
    """
    n = data.q.shape[1]
    directions, square = np.eye(n), n == len(u.columns)
    results = []
    for i, (name, equation) in enumerate(zip(u.columns, equations, strict=True)):
        regression = equation.regression
        weights = equation.weights[0, regression.block]
        power = data.u[:, 0, [i]] * data.v
        shares = (weights @ power) / (weights @ np.abs(power)).clip(min=1e-300)
        k = i if square else _driven(data, power)
        motion, columns = data, equation.columns
        if not square:  # The accelerations of passive joints follow from that of the driven joint.
            motion = replace(data, a=directions[k] * data.a)
            columns = {**force_columns(motion, i, rigid), "y": columns["y"]}
            regression = EquationOfMotionRegression(columns, data.block, data.row_weights())
        fit = regression.fit("y", equation.x, equation.weights)
        x = np.hstack([columns[key] for key in equation.x])
        pushed = force_columns(replace(motion, a=motion.a + directions[k]), i, rigid)
        change = np.hstack([pushed[key] for key in equation.x]) - x
        inertia = change @ fit.theta[0, :, 0]
        left = columns["y"][:, 0] - x @ fit.theta[0, :, 0]
        smallest = max(2 * np.std(left), _NOTICEABLE * np.std(columns["y"]))
        clear = np.std(inertia * data.a[:, k]) > smallest
        positive = weights @ (inertia > 0) / weights.sum()
        bad = bool(clear and positive < 0.1 and shares[k] < (0.2 if square else -0.2))
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


def _driven(data: Averages, power: np.ndarray) -> int:
    """Return the joint k whose power u v_k ``(R, N)`` is that of an energy E(q, v) and friction."""
    inside = np.diff(data.block) == 0
    energies = np.diff(terms(data, "acceleration"), axis=0)
    heats = np.hstack([data.v**2, np.abs(data.v)])
    columns = {
        "terms": np.hstack([energies, heats[1:] + heats[:-1]])[inside],
        "power": (power[1:] + power[:-1])[inside],
    }
    regression = EquationOfMotionRegression(columns, data.block[1:][inside])
    return int(regression.fit("power", ["terms"]).shares()[0].argmin())
