"""Faults of an input that look like a delay: a drifting clock, a saturated drive, held values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pinn_dyn.data.logs import Columns, Measurement, Recording
from pinn_dyn.data.logs.check.checks import held_rows
from pinn_dyn.data.logs.measurement import judged
from pinn_dyn.log_check.averages import Averages
from pinn_dyn.log_check.delay import FEWEST, DelayCurve, minimum
from pinn_dyn.log_check.equation import Regressor, force_columns, solve

HELD = "rows between two values of the input"
"""Name of the measurement of inputs that are slower than the log."""
DRIFT = "clock drift [%]"
"""Name of the measurement of clocks of the inputs."""
SATURATED = "saturated samples"
"""Name of the measurement of commands that exceed what acts."""
_ROWS = 2500  # of the regression
_LARGEST_DRIFT = 0.05
_SHIFT = 0.02  # distance of candidates at the end of a run, s
_LONGEST = 60.0  # s of a run that are used
_CONSTANT = np.arange(-0.1, 0.11, 0.02)  # s, constant shifts that are tried beside the best delay
SATURATES = "is a command that its drive cannot follow"
"""Words of the finding that a model with limits of its drives accounts for."""
_QUANTILES = np.linspace(0.5, 0.97, 20)  # of |u|, for saturation
_LESS = 0.5  # residual over that of a constant delay, below which a fault is clear
_SMALL, _CLEAR = 1e-3, 0.2  # residuals: too small to matter; small enough to trust


@dataclass(frozen=True)
class _Trial:
    """Rows of an input at which its joint moves, and the columns that explain it, ``(R, P)``."""

    data: Averages
    explained: np.ndarray
    delay: float

    def residual(self, y: np.ndarray, fitted: np.ndarray | None = None) -> np.ndarray:
        """Return what the columns leave of y ``(R, K)``, fitted in the rows of a mask."""
        rows = np.ones(len(y), dtype=bool) if fitted is None else fitted
        x = np.column_stack([self.explained, np.ones(len(y))])
        return y - x @ solve(x[rows], y[rows])

    def shares(self, y: np.ndarray) -> np.ndarray:
        """Return the share of the variance of each column of y that stays unexplained, ``(K,)``."""
        return self.residual(y).var(axis=0) / y.var(axis=0).clip(min=1e-300)


def input_faults(
    widths: Sequence[Averages],
    curves: Sequence[DelayCurve],
    u: Columns,
    rigid: Regressor | None = None,
) -> tuple[list[Measurement], list[DelayCurve], list[int]]:
    """Look for faults of inputs that kernels of two widths agree on, see :func:`_faults`."""
    results, changed, held = _faults(widths[0], curves, u, rigid)
    if all(x.verdict == "ok" for x in results):
        return results, changed, held
    again, _, _ = _faults(widths[1], curves, u, rigid)
    if [x.verdict for x in results] == [x.verdict for x in again]:
        return results, changed, held
    return [replace(x, verdict="ok", text="") for x in results], list(curves), [1] * len(curves)


def _faults(
    data: Averages,
    curves: Sequence[DelayCurve],
    u: Columns,
    rigid: Regressor | None,
) -> tuple[list[Measurement], list[DelayCurve], list[int]]:
    """Look for inputs whose clock drifts, whose drive saturates, or that are held for rows.

    The candidates for what acts are u(t - d), u(t0 + (1 + r) (t - t0)), u limited to +-c, and u
    drawn by lines between its updates. The one that leaves the least of the equation of motion
    unexplained counts, if it leaves less than half of what a constant delay leaves.

    Returns:
        Measurements, the curves without the delays of these inputs, and for each input the rows
        between the updates that lines have to join, or 1.
    """
    results: list[Measurement] = []
    changed, held = list(curves), [1] * len(curves)
    if len(curves) > data.q.shape[1]:
        return results, changed, held
    ends = {k: data.passed[data.run == k].max() for k in np.unique(data.run)}
    # The end of a run has no input of a clock that is slow.
    last = np.array([ends[k] for k in data.run])
    inside = (data.passed < _LONGEST) & (data.passed * (1 + _LARGEST_DRIFT) <= last)
    used = data.rows(inside).thinned(_ROWS)
    regressor = None if rigid is None else rigid(used.q, used.v, used.a)
    for i, (name, unit) in enumerate(zip(u.columns, u.units, strict=True)):
        moving = used.moving_rows(i)
        drift, level, share = 0.0, np.inf, 0.0
        rows = max((held_rows(x.u[:, [i]]) for x in data.recordings), default=1)
        if moving.sum() >= FEWEST:
            trial = _trial(used.rows(moving), i, curves[i], regressor, moving)
            shifts = trial.data.t[:, None] - [trial.delay, *_CONSTANT]
            constant = trial.shares(trial.data.input_at(i, shifts)).min()
            if rows > 1 and _follows_lines(trial, i):
                held[i] = rows
            elif constant > _SMALL:
                level, share = _saturation(trial, i)
                drift = 0.0 if share else _drift(trial, i, min(_LESS * constant, _CLEAR))
        results += [
            _drifts(name, drift, max(x.t[-1] - x.t[0] for x in data.recordings)),
            _saturates(name, share, f"{level:.2g} {unit}"),
            _is_held(name, rows, data.step, held[i] > 1),
        ]
        if share:
            changed[i] = curves[i].without("the drive saturates")
        if held[i] > 1:
            changed[i] = curves[i].without("the input is held")
        if drift:
            reason = "the clock of the inputs drifts"
            changed = [x.without(x.reason or reason) for x in changed]
    return results, changed, held


def _drifts(name: str, drift: float, longest: float) -> Measurement:
    return judged(
        name=DRIFT,
        place=name,
        value=100 * abs(drift),
        expected="0",
        bad=drift != 0,
        text=f"the clock of input {name!r} drifts by {100 * abs(drift):.2g} % against that of q: "
        f"at {longest:.3g} s it is {abs(drift) * 1e3 * longest:.3g} ms too "
        f"{'late' if drift > 0 else 'early'}, which no constant delay repairs; log it with the "
        "clock of q, or correct its times",
    )


def _saturates(name: str, share: float, level: str) -> Measurement:
    return judged(
        name=SATURATED,
        place=name,
        value=share,
        expected="0",
        bad=share > 0,
        text=f"input {name!r} {SATURATES}: about {level} act where more is logged "
        f"({100 * share:.0f} % of the samples); log the measured force, or limit the column to "
        "what the drive can do",
    )


def _is_held(name: str, rows: int, step: float, bad: bool) -> Measurement:
    return judged(
        name=HELD,
        place=name,
        value=rows,
        expected="1",
        bad=bad,
        text=f"input {name!r} is held at {1 / (rows * step):.3g} Hz: its values repeat for {rows} "
        "rows, but the motion follows lines between them: add the step below to the data set",
    )


def _trial(
    data: Averages, i: int, curve: DelayCurve, regressor: np.ndarray | None, rows: np.ndarray
) -> _Trial:
    columns = force_columns(data, i, None if regressor is None else regressor[rows])
    if regressor is not None:  # a spring beside gravity is no limit of a drive
        columns["spring"] = data.q[:, [i]]
    delay = float(curve.candidates[int(curve.residual.argmin())])
    return _Trial(data, np.column_stack(list(columns.values())), delay)


def _drift(trial: _Trial, i: int, limit: float) -> float:
    """Return the drift of the clock that leaves least; 0 if it leaves more than a limit."""
    passed = trial.data.passed
    count = max(int(_LARGEST_DRIFT * passed.max() / _SHIFT), 1)
    drifts = np.arange(-count, count + 1) * _SHIFT / passed.max()
    shares = trial.shares(trial.data.input_at(i, trial.data.t[:, None] + drifts * passed[:, None]))
    return minimum(drifts, shares) if shares.min() < limit else 0.0


def _follows_lines(trial: _Trial, i: int) -> bool:
    """Tell whether the motion follows lines between the updates of an input, not held values.

    Neither may act before it is logged: held values do, on average half a hold, if they are lines.
    """

    def lines(item: Recording) -> np.ndarray:
        x = item.u[:, i]
        updates = np.flatnonzero(np.r_[True, x[1:] != x[:-1]])
        return np.interp(item.t, item.t[updates], x[updates])[:, None]

    delays = [0.0, max(trial.delay, 0.0)]
    held = trial.data.input_at(i, trial.data.t[:, None] - delays)
    joined = trial.data.averaged(lines, delays)[:, :, 0]
    return bool(trial.shares(joined).min() < _LESS * trial.shares(held).min())


def _saturation(trial: _Trial, i: int) -> tuple[float, float]:
    """Return the level of a saturation and the share of the samples beyond it; inf and 0 if none.

    The equation is fitted to u limited to +-c. It must leave less of the force than that of u, on
    the samples below c alone, as limited numbers have a smaller residual anyway. At the samples
    beyond c, the force that the equation of the samples below predicts must be c rather than u.
    """
    signals = np.concatenate([item.u[:, i] for item in trial.data.recordings])
    levels = np.quantile(np.abs(signals), _QUANTILES)
    limited = trial.data.averaged(lambda item: item.u[:, [i]].clip(-levels, levels), [trial.delay])[
        :, 0
    ]
    logged = trial.data.input_at(i, trial.data.t[:, None] - trial.delay)
    left, left_limited = trial.residual(logged), trial.residual(limited)
    ratios = np.full(len(levels), np.inf)
    for k, level in enumerate(levels):
        below = np.abs(logged[:, 0]) < level
        if min(below.sum(), (~below).sum()) < FEWEST // 10:
            continue
        ratio = (left_limited[below, k] ** 2).mean() / (left[below, 0] ** 2).mean()
        beyond = trial.residual(logged, below)[~below, 0]
        excess = (logged[:, 0] - limited[:, k])[~below]
        if ratio < _LESS:
            ratios[k] = np.sqrt(((beyond - excess) ** 2).mean() / (beyond**2).mean())
    k = int(ratios.argmin())
    # The lowest level is the edge of the candidates.
    if k == 0 or not ratios[k] < _LESS or trial.shares(limited)[k] > _CLEAR:
        return np.inf, 0.0
    return float(levels[k]), float((np.abs(signals) > levels[k]).mean())
