"""Comparison of the runs of a log by their common equation of motion.

    inverse dynamics    u = f(q, v, a),            with at most as many inputs as coordinates
    increments          v = f(q) + B u,            with more inputs
    acceleration        a = f(q, v) + B u,         with more inputs, if it leaves less unexplained
                        a = f(q, v),               with no inputs

f is linear in its parameters. Stretches that disagree with the others lose their weight
(iteratively reweighted least squares with the loss of Geman and McClure 1985).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.delay_regression import Smoothed, averages, signs, terms
from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.data.logs.recording import Recording

_WIDTH, _CUT = 0.03, 3.0  # of the averages, s; widths at which their kernel ends
_ROWS, _FEWEST, _PER_TERM = 7_000, 40, 6  # rows at most, of a run at least, per term at least
_BLOCKS = 8  # of a run
_RESIDUAL, _RATIO = 0.3, 3.0  # of a bad run: share of the signal, and of the median run's residual
_CLEAR = 0.9  # correlation from which a scale is clear
_SCALES = (0.55, 1.8)  # of another load; beyond, another unit


class _Fit(NamedTuple):
    """Fit y = X theta: terms ``(R, P)``, ``(R, K)``, ``(P, K)``; weight and residual of blocks."""

    x: np.ndarray
    y: np.ndarray
    theta: np.ndarray
    weights: np.ndarray
    residual: np.ndarray

    def of_runs(self) -> np.ndarray:
        """Return the residual of each run, that of its second worst block, ``(runs, K)``."""
        return np.sort(self.residual.reshape(-1, _BLOCKS, self.y.shape[1]), axis=1)[:, -2]


def _fit(data: Smoothed, x: np.ndarray, y: np.ndarray, weights: np.ndarray | None = None) -> _Fit:
    """Fit with these weights of the blocks; None fits the weights, too."""
    size, count = y.shape[1], np.bincount(data.block)

    def spread(z: np.ndarray) -> np.ndarray:
        squares = [np.bincount(data.block, column**2) for column in z.T]
        return np.sqrt(np.transpose(squares) / count[:, None])

    spreads = spread(np.hstack([y, data.u - np.median(data.u, axis=0)]))
    usual = np.maximum(np.median(spreads, axis=0), 1e-9 * spreads.max(axis=0)).clip(min=1e-300)
    spreads = spreads / usual
    # A run in a larger unit, or a jump of q, would outweigh all others.
    largest = spreads.clip(min=1).max(axis=1)[data.block]
    usual_a = np.median(np.abs(data.a), axis=0).clip(min=1e-300)
    largest *= (np.abs(data.a) / usual_a / 10).clip(1, 1e6).max(axis=1) ** 2
    norms, scaled = np.sqrt((x**2).mean(axis=0)).clip(min=1e-300), y / usual[:size]
    z, fixed = x / norms, weights is not None
    weights = np.ones(len(count)) if weights is None else weights
    for cut in [1.0] if fixed else 0.5 ** np.arange(1, 8):
        rows = (weights[data.block] / largest**2)[:, None]
        gram = z.T @ (rows * z)
        gram += 1e-8 * np.trace(gram) / len(gram) * np.eye(len(gram))
        theta = np.linalg.solve(gram, z.T @ (rows * scaled))
        residual = spread(scaled - z @ theta) / np.maximum(spreads, 1)[:, :size]
        if not fixed:
            worst = (residual / np.median(residual, axis=0).clip(min=1e-3)).max(axis=1)
            weights = 1 / (1 + (worst / max(2.5, cut * worst.max())) ** 2) ** 2
    return _Fit(x, y, theta * usual[:size] / norms[:, None], weights, residual)


def _inverse(data: Smoothed) -> np.ndarray:
    return np.hstack([terms(data, "inverse dynamics"), data.sign])


def check_runs(
    recordings: Sequence[Recording], q: Columns, u: Columns, step: float
) -> list[Measurement]:
    """Compare each run with the equation of the others, and measure the signs of the forces.

    Fewer than three runs, or too few rows for the terms, are not compared.
    """
    size, n = len(u.columns), len(q.columns)
    samples = max(_WIDTH / step, 1.5)
    edge = int(np.ceil(_CUT * samples))
    stride = max(1, int(samples), sum(map(len, recordings)) / _ROWS)
    parts: dict[str, list[np.ndarray]] = {}
    for item in sorted(recordings, key=lambda item: item.t[0]):
        rows = np.arange(edge, len(item) - edge, stride).astype(int)
        orders = *((item.q, order) for order in range(3)), (item.u[:, :size], 0)
        smooth = [
            averages(x, samples, step, order, _CUT)[rows]
            for x, order in (*orders, (signs(item.q, step)[0], 0))
        ]
        parts.setdefault(item.run, []).append(np.hstack([item.t[rows, None], *smooth]))
    runs = {run: np.vstack(x) for run, x in parts.items() if sum(map(len, x)) >= _FEWEST}
    if not runs:
        return []
    signals = np.split(np.vstack(list(runs.values())), [1, 1 + n, 1 + 2 * n, 1 + 3 * n, -n], axis=1)
    tenths = [np.arange(len(x)) * _BLOCKS // len(x) for x in runs.values()]
    blocks = np.concatenate([_BLOCKS * k + x for k, x in enumerate(tenths)])
    _, motion, v, a, inputs, sign = signals
    data = Smoothed(motion, v, a, sign, sign[:, :0], sign != 0, inputs, np.ones(size), blocks)
    inverse = size <= n
    if inverse:
        driven = _inverse(data), data.u - np.median(data.u, axis=0)
        passive = np.hstack([terms(data, "acceleration"), sign]), data.a
        sides = [driven if size else passive]
    else:
        inputs = (data.u - data.u.mean(axis=0)) / data.u.std(axis=0).clip(min=1e-300)
        forms = (("increments", data.v), ("acceleration", data.a))
        sides = [(np.hstack([terms(data, form), inputs]), y) for form, y in forms]
    if len(blocks) < _PER_TERM * max(x.shape[1] for x, _ in sides):
        return []
    fit = min((_fit(data, *side) for side in sides), key=lambda fit: np.median(fit.residual))
    results = []
    if len(runs) >= 3:
        labels = u.columns if inverse and size else q.columns
        results = _bad_runs(fit, data, list(runs), signals[0][:, 0], labels, inverse)
    return [*results, *(_signs(fit, data, u) if inverse and set(u.units) <= {"Nm", "N"} else [])]


def _bad_runs(
    fit: _Fit, data: Smoothed, runs: list[str], t: np.ndarray, labels: Sequence[str], inverse: bool
) -> list[Measurement]:
    residual = fit.of_runs()
    usual = np.median(residual, axis=0).clip(min=1e-3)
    ratios = residual / usual
    suspects = np.flatnonzero(((residual > _RESIDUAL) & (ratios > _RATIO)).any(axis=1))
    name, expected = "residual over that of the median run", f"below {_RATIO:g}"
    results = []
    for k in suspects if len(suspects) <= len(runs) // 3 else ():
        # A motion that no other run has may be extrapolated badly: include it in the fit.
        weights = np.where(np.arange(len(fit.weights)) // _BLOCKS == k, 1, fit.weights)
        included = _fit(data, fit.x, fit.y, weights).of_runs()[k]
        bad = (included > _RESIDUAL) & (included > _RATIO / 1.5 * usual)
        if not bad.any():
            continue
        j = int((bad * ratios[k]).argmax())
        odd = fit.residual[:, j] > max(_RESIDUAL, 2 * usual[j]) / 1.5
        rows = (data.block // _BLOCKS == k) & odd[data.block]
        text = (
            f"run {runs[k]} does not fit the other runs from {t[rows][0]:.4g} to {t[rows][-1]:.4g} "
            f"s: the residual of {labels[j]!r} is {ratios[k, j]:.3g} times that of the median run; "
            f"{_cause(fit, data, rows, j, labels, inverse)} Correct or leave out the run: all "
            "numbers of the check include it"
        )
        results.append(judged(name, runs[k], ratios[k, j], expected, True, text))
    worst = int(ratios.max(axis=1).argmax())
    return results or [judged(name, runs[worst], ratios[worst].max(), expected, False, "")]


def _cause(
    fit: _Fit, data: Smoothed, rows: np.ndarray, j: int, labels: Sequence[str], inverse: bool
) -> str:
    """Return the likely cause in rows whose left side j does not fit."""
    inputs = range(data.u.shape[1])
    for i in inputs[j : j + 1] if inverse else inputs:
        u = data.u[rows, i]
        if np.ptp(data.u[:, i]) > 0 and np.isclose(u, np.median(u), 1e-6, 0).mean() > 0.5:
            return f"input {i + 1} is constant there: is a sensor stuck?"
    measured, predicted = fit.y[rows], fit.x[rows] @ fit.theta
    name = f"{labels[j]!r}"
    if not inverse:
        effect = fit.x[rows, -data.u.shape[1] :] @ fit.theta[-data.u.shape[1] :]
        measured, predicted = effect, measured - predicted + effect
        name = f"the effect of the inputs on {labels[j]!r}"
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


def _signs(fit: _Fit, data: Smoothed, u: Columns) -> list[Measurement]:
    """Measure the effective inertia and the mean power of each force or torque.

    Both are positive at the joint that the force drives: M(q) is positive definite, and the robot
    dissipates. With fewer forces than coordinates this is the joint whose power fits an energy.
    """
    weights, directions = fit.weights[data.block], np.eye(data.q.shape[1])
    square = len(directions) == len(u.columns)
    results = []
    for i, name in enumerate(u.columns):
        power = data.u[:, [i]] * data.v
        shares = (weights @ power) / (weights @ np.abs(power)).clip(min=1e-300)
        k = i if square else _driven(data, power)
        # The accelerations of passive joints follow from that of the driven joint.
        motion = data if square else replace(data, a=directions[k] * data.a)
        x = _inverse(motion)
        theta = (fit if square else _fit(data, x, fit.y, fit.weights)).theta[:, i]
        inertia = (_inverse(replace(motion, a=motion.a + directions[k])) - x) @ theta
        clear = np.std(inertia * data.a[:, k]) > 2 * np.std(fit.y[:, i] - x @ theta)
        positive = weights @ (inertia > 0) / weights.sum()
        bad = bool(clear and positive < 0.1 and shares[k] < (0.2 if square else -0.2))
        text = (
            f"input {name!r} seems to push backwards: the effective inertia of coordinate {k + 1} "
            f"is {weights @ inertia / weights.sum():.3g} and its mean power "
            f"{weights @ power[:, k] / weights.sum():.3g} W, expected above 0: is it reversed?"
        )
        measured = ("share of positive effective inertia", name, positive)
        results.append(judged(*measured, "above 0.1 where it is clear", bad, text))
    return results


def _driven(data: Smoothed, power: np.ndarray) -> int:
    """Return the joint k whose power u v_k ``(R, N)`` is that of an energy E(q, v) and friction."""
    inside = np.diff(data.block) == 0
    energies = np.diff(terms(data, "acceleration"), axis=0)
    heats = np.hstack([data.v**2, np.abs(data.v)])
    x, y = np.hstack([energies, heats[1:] + heats[:-1]])[inside], (power[1:] + power[:-1])[inside]
    x = x / np.sqrt((x**2).mean(axis=0)).clip(min=1e-300)
    left = y - x @ np.linalg.lstsq(x, y, rcond=1e-6)[0]
    shares = (left**2).sum(axis=0) / (y**2).sum(axis=0).clip(min=1e-300)
    return int(shares.argmin())
