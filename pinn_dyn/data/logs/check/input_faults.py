"""Faults of an input that look like a delay: a clock that drifts, a drive that saturates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pinn_dyn.data.logs.check.averages import Averages
from pinn_dyn.data.logs.check.delay import FEWEST, DelayCurve, force_columns
from pinn_dyn.data.logs.check.equation import EquationOfMotionRegression, Regressor
from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.data.logs.recording import Recording

SATURATED = "saturated samples"
"""Name of the measurement of commands that a drive cannot follow."""
_LARGEST_DRIFT = 0.05
_SHIFT = 0.02  # distance of candidates at the end of a run, s
_LONGEST = 60.0  # s of a run that are used
_CONSTANT = np.arange(-0.1, 0.11, 0.02)  # s, constant shifts that are tried beside the best delay
_QUANTILES = np.array([0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95])  # of |u|, for saturation
_LESS = 0.5  # residual over that of a constant delay, below which a fault is clear
_SMALL, _CLEAR = 1e-3, 0.2  # residuals: too small to matter; small enough to trust


def delayed(recordings: Sequence[Recording], delays: Sequence[float]) -> list[Recording]:
    """Return recordings with the input ``u_i(t - d_i)`` at t."""
    return [
        replace(x, u=np.column_stack([_at(x, i, x.t - d) for i, d in enumerate(delays)]))
        if any(delays)
        else x
        for x in recordings
    ]


def input_faults(
    recordings: Sequence[Recording],
    curves: Sequence[DelayCurve],
    u: Columns,
    step: float,
    rigid: Regressor | None = None,
) -> tuple[list[Measurement], list[DelayCurve]]:
    """Look for inputs whose clock drifts or whose drive saturates; such an input has no delay.

    The candidates for what acts are u(t - d), u(t0 + (1 + r) (t - t0)) and u limited to +-c. The
    one that leaves the least of the equation of motion unexplained counts, if it leaves less than
    half of what a constant delay leaves.

    Returns:
        Measurements, and the curves without the delays of these inputs.
    """
    size, inputs = recordings[0].q.shape[1], len(curves)
    if not inputs or inputs > size:
        return [], list(curves)
    starts: dict[str, float] = {}
    for item in recordings:
        starts[item.run] = min(starts.get(item.run, item.t[0]), item.t[0])
    used = [x.rows(x.t - starts[x.run] < _LONGEST) for x in recordings]
    duration = max(float(x.t[-1] - starts[x.run]) for x in used)
    half = np.arange(1, int(_LARGEST_DRIFT * duration / _SHIFT) + 1) * _SHIFT / duration
    drifts = np.concatenate([-half[::-1], half])
    levels = np.quantile(np.abs(np.vstack([x.u for x in used])), _QUANTILES, axis=0)
    shares = _shares(used, curves, starts, drifts, levels, step, rigid)
    results, changed, drifts_found = [], list(curves), False
    edges = 1 + len(_CONSTANT) + np.array([0, len(drifts)])
    for i, (name, unit) in enumerate(zip(u.columns, u.units, strict=True)):
        constant, of_drifts, of_levels = (x.min() for x in np.split(shares[i], edges))
        clear = min(of_drifts, of_levels) < min(_LESS * constant, _CLEAR) and constant > _SMALL
        drifting, saturated = clear and of_drifts < of_levels, clear and of_levels <= of_drifts
        best = int(shares[i].argmin())
        drift = 100 * drifts[best - edges[0]] if drifting else 0.0
        text = (
            f"the clock of input {name!r} drifts by {abs(drift):.2g} % against that of q: at "
            f"{duration:.3g} s it is {abs(drift) * 10 * duration:.3g} ms too "
            f"{'late' if drift > 0 else 'early'}, which no constant delay repairs; log it with the "
            "clock of q, or correct its times"
        )
        results.append(judged("clock drift [%]", name, abs(drift), "0", drifting, text))
        level = levels[best - edges[1], i] if saturated else np.inf
        share = np.mean(np.abs(np.concatenate([x.u[:, i] for x in used])) > level)
        text = (
            f"input {name!r} is a command that its drive cannot follow: about {level:.2g} {unit} "
            f"act where more is logged ({100 * share:.0f} % of the samples); log the measured "
            "force, limit the column to what the drive can do, or give known mechanics its limits"
        )
        results.append(judged(SATURATED, name, share, "0", saturated, text))
        if saturated:
            changed[i] = replace(curves[i], delay=None, reason="the drive saturates")
        drifts_found = drifts_found or drifting
    if drifts_found:
        reason = "the clock of the inputs drifts"
        changed = [replace(x, delay=None, reason=x.reason or reason) for x in changed]
    return results, changed


def _shares(
    recordings: Sequence[Recording],
    curves: Sequence[DelayCurve],
    starts: dict[str, float],
    drifts: np.ndarray,
    levels: np.ndarray,
    step: float,
    rigid: Regressor | None,
) -> np.ndarray:
    """Return what each candidate leaves unexplained: best delay, drifts, levels, ``(M, K)``."""
    parts = []
    for x in recordings:
        passed = x.t - starts[x.run]
        columns = []
        for i, curve in enumerate(curves):
            delay = curve.candidates[int(curve.residual.argmin())]
            columns += [_at(x, i, x.t - d) for d in (delay, *_CONSTANT)]
            columns += [_at(x, i, starts[x.run] + (1 + r) * passed) for r in drifts]
            columns += [x.u[:, i].clip(-level, level) for level in levels[:, i]]
        # The end of a run has no input of a clock that is slow.
        inside = passed * (1 + _LARGEST_DRIFT) <= passed[-1]
        parts.append(replace(x, u=np.column_stack(columns)).rows(inside))
    data = Averages.of(parts, step)
    count = 1 + len(_CONSTANT) + len(drifts) + len(levels)
    if data is None:
        return np.ones((len(curves), count))
    results = []
    for i in range(len(curves)):
        rows = data.rows(data.moving_rows(i, len(curves)))
        if len(rows.t) < FEWEST:
            results.append(np.ones(count))
            continue
        explained = force_columns(rows, i, rigid)
        if rigid is not None:  # a spring beside gravity is no limit of a drive
            explained["spring"] = rows.q[:, [i]]
        y = rows.u[:, 0, i * count : (i + 1) * count]
        y = y - y.mean(axis=0)
        regression = EquationOfMotionRegression({**explained, "u": y}, np.zeros(len(y), dtype=int))
        results.append(regression.fit("u", list(explained)).shares()[0])
    return np.array(results)


def _at(recording: Recording, i: int, t: np.ndarray) -> np.ndarray:
    return np.interp(t, recording.t, recording.u[:, i])
