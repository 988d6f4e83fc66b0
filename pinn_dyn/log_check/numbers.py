"""Numbers of a log check: share of the inputs, targets, units of angles, and lag of v."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pinn_dyn.data.logs import Columns, Measurement, Recording
from pinn_dyn.data.logs.measurement import judged
from pinn_dyn.log_check.averages import Averages
from pinn_dyn.log_check.equation import terms, unexplained

_LAGS = 30  # of a target that are tried
_STILL = 0.01  # variance of a coordinate at rest as a share of the largest
_FREE = 0.03  # largest share of the acceleration of a free motor that its input leaves
_BETTER = 0.5  # residual with one unit of an angle over that with the other
_EXACT = 1e-6  # residual that is one of rounding
_LONGEST, _LAGGED = 0.2, 0.5  # lag of v, s; share over that without a lag
_CLEAR = 0.8  # correlation of v and dq/dt


def explained_share(data: Averages) -> float:
    """Return the largest share of v and a that the inputs explain beside (1, q, v).

    The result is 1 where the independent rows are too few to tell.
    """
    data = data.independent()
    data = data.rows(data.row_weights()[:, 0] == 1)  # no stop, no jump of q
    q, v, u = data.q, data.v - data.v.mean(axis=0), data.u - data.u.mean(axis=0)
    if len(data) < 6 * (3 * q.shape[1] + u.shape[1]):
        return 1.0
    known = q, np.sin(q), np.cos(q)
    return max(
        unexplained(v, *known) - unexplained(v, *known, u),
        unexplained(data.a, *known, v) - unexplained(data.a, *known, v, u),
        # The acceleration of a controlled robot may follow from q and v; its torque then does too.
        1 - unexplained(u, *known, v, data.a),
    )


def target_distance(training: Sequence[Recording], step: float, longest: float) -> float:
    """Return the share of the variance of q that delayed targets u do not explain.

    The delay of each coordinate is the best one up to ``longest``, s. A constant offset between
    target and q does not count. The result is that of the worst coordinate.
    """
    size = training[0].q.shape[1]
    if training[0].u.shape[1] not in (size, 2 * size):
        return np.inf
    spread = np.vstack([item.q for item in training]).var(axis=0)
    spread = spread.clip(min=max(_STILL * spread.max(), 1e-300))
    lags = range(0, round(longest / step) + 1, max(round(longest / step / _LAGS), 1))
    shares = []
    for lag in lags:
        parts = [item.q[lag:] - item.u[: len(item) - lag, :size] for item in training]
        shares.append(np.vstack(parts).var(axis=0) / spread)
    return float(np.min(shares, axis=0).max())


def check_angles(data: Averages, q: Columns, free: Sequence[bool]) -> list[Measurement]:
    """Measure the largest angles; an angle beyond 4 pi rad is probably in degrees.

    Args:
        data: averages of the log.
        q: columns of the coordinates.
        free: coordinates whose joint may turn without end by its description.
    """
    results = []
    for k in (k for k, unit in enumerate(q.units) if unit == "rad"):
        recordings = data.recordings
        angle, run = max((float(np.abs(item.q[:, k]).max()), item.run) for item in recordings)
        measurement = judged(
            name="largest angle [rad]",
            place=q.columns[k],
            value=angle,
            expected="below 4 pi",
            bad=angle > 4 * math.pi and not free[k] and not _turns(data, k),
            text=f"{run}, column {q.columns[k]!r}: an angle of {angle:.4g} rad is more than two "
            f"turns: is it in degrees? Its unit is configured as {q.unit[k]!r}",
        )
        results.append(measurement)
    return results


def _turns(data: Averages, k: int) -> bool:
    """Tell whether angle k grows up to the end, or its joint has the period of a turn.

    A free motor, whose acceleration follows from its input and its friction, may turn, too.
    """
    steps = [np.diff(item.q[:: max(1, len(item) // 50), k]) for item in data.recordings]
    path, last = sum(np.abs(x).sum() for x in steps), sum(abs(x[-1]) * len(x) for x in steps)
    if sum(abs(x.sum()) for x in steps) > 0.9 * path and last > 0.1 * path:
        return True
    a, inputs = data.a[:, [k]], data.u
    if unexplained(a, data.v, inputs, np.sign(data.v)) < _FREE:
        return True
    degrees = np.where(np.arange(data.q.shape[1]) == k, math.pi / 180, 1.0)
    converted = replace(data, q=data.q * degrees)
    y = data.u if inputs.shape[1] else a
    form = "inverse dynamics" if inputs.shape[1] else "acceleration"
    in_radians, in_degrees = (unexplained(y, terms(x, form)) for x in (data, converted))
    return in_radians < _BETTER * in_degrees and in_degrees > _EXACT


def check_velocity_lag(data: Averages, q: Columns, v: Columns) -> list[Measurement]:
    """Measure the lag of v behind dq/dt, as that of a filter or of another clock."""
    step, shortest = data.step, min(map(len, data.recordings))
    last = max(2, min(round(_LONGEST / step), shortest // 4))
    lags = np.unique(np.linspace(-last, last, 2 * min(last, 20) + 1).round().astype(int))
    data = data.rows((data.since >= last * step) & (data.left >= last * step))
    if not len(data):
        return []
    measured = data.averaged(lambda item: np.asarray(item.v), lags * step)
    results = []
    for k, (a, b) in enumerate(zip(q.columns, v.columns, strict=True)):
        columns = measured[:, :, [k]].swapaxes(0, 1)
        shares = np.array([unexplained(x, data.v[:, [k]]) for x in columns])
        best = int(shares.argmin())
        # Lag l of a column means that it is read l samples earlier: a late v needs a negative one.
        lag = -lags[best] * step
        clear = shares[best] < min(_LAGGED * shares[lags == 0][0], 1 - _CLEAR**2)
        measurement = judged(
            name="lag of v [ms]",
            place=f"{a}, {b}",
            value=1e3 * lag,
            expected="0",
            bad=bool(clear and abs(lag) > 1.5 * step),
            text=f"column {b!r} is {1e3 * abs(lag):.3g} ms {'behind' if lag > 0 else 'ahead of'} "
            f"the derivative of {a!r}: is it filtered or from another clock? Leave out v (it is "
            "then computed from q), or correct its times",
        )
        results.append(measurement)
    return results
