"""Measurements that tell whether the signals of a log fit together: units, signs, velocities."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import scipy

from pinn_dyn import wording
from pinn_dyn.data.logs.check.averages import Averages
from pinn_dyn.data.logs.check.equation import EquationOfMotionRegression
from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.measurement import Measurement, Verdict, judged
from pinn_dyn.data.logs.recording import Recording

_FACTORS = (0.8, 1.25)  # range of dq/dt over v without a warning
_CLEAR = 0.8  # correlation from which the factor is determined
_AT_REST, _ALL_AT_REST = 0.9, 0.98  # shares of samples at rest of a warning and of a stop
_STILL = 1e-12  # range of a coordinate that does not move, m or rad
_TENTHS, _MOST_ODD = 10, 0.6  # parts of a stretch; largest share of parts that disagree
_PERIODIC = 0.6  # of the acceleration: largest share that periodic terms leave
_FREE = 0.03  # largest share of the acceleration of a free motor that its input leaves
_NEXT = 0.02  # median steps of q between an input and the next q
_LAGS, _LAGGED = 0.2, 0.5  # of v: longest, s; share over that without a lag
_MOVING, _LEFT = 0.05, 0.7  # of a tenth: share of the mean square, share of Δq² that k v leaves


def check_inputs(training: list[Recording], q: Columns, u: Columns) -> list[Measurement]:
    """Measure the range of each input in the training, and compare it with the next q."""
    ranges = np.ptp(np.vstack([item.u[:, : len(u.columns)] for item in training]), axis=0)
    text = "input {!r} is constant in the training runs: its effect cannot be learned"
    results = [
        judged("range of the input", name, size, "above 0", size == 0, text.format(name))
        for name, size in zip(u.columns, ranges, strict=True)
    ]
    steps = np.vstack([np.diff(item.q, axis=0) for item in training])
    usual = np.median(np.abs(steps), axis=0).clip(min=1e-300)
    for i, name in enumerate(u.columns):
        following = np.vstack([item.u[:-1, [i]] - item.q[1:] for item in training])
        distance = np.median(np.abs(following), axis=0) / usual
        k = int(distance.argmin())
        text = (
            f"input {name!r} is {q.columns[k]!r} of the next row, not a command: any model "
            "predicts q from it, and no controller can use it; log the command that is sent"
        )
        bad = bool(distance[k] < _NEXT)
        measured = ("distance of the input from the next q", name, distance[k])
        results.append(judged(*measured, f"above {_NEXT:g} steps", bad, text, "stop"))
    return results


def check_angles(recordings: list[Recording], q: Columns, step: float) -> list[Measurement]:
    """Measure the largest angles; an angle beyond 4 pi rad is probably in degrees."""
    results = []
    for k in (k for k, unit in enumerate(q.units) if unit == "rad"):
        angle, run = max((float(np.abs(item.q[:, k]).max()), item.run) for item in recordings)
        text = (
            f"{run}, column {q.columns[k]!r}: an angle of {angle:.4g} rad is more than two turns: "
            f"is it in degrees? Its unit is configured as {q.unit[k]!r}"
        )
        bad = angle > 4 * math.pi and not _turns(recordings, k, step)
        results.append(judged("largest angle [rad]", q.columns[k], angle, "below 4 pi", bad, text))
    return results


def _turns(recordings: list[Recording], k: int, step: float) -> bool:
    """Tell whether angle k grows up to the end, or its acceleration has the period of a turn.

    A free motor, whose acceleration follows from its input and its friction, may turn, too.
    """
    steps = [np.diff(item.q[:: max(1, len(item) // 50), k]) for item in recordings]
    path, last = sum(np.abs(x).sum() for x in steps), sum(abs(x[-1]) * len(x) for x in steps)
    if sum(abs(x.sum()) for x in steps) > 0.9 * path and last > 0.1 * path:
        return True
    data = Averages.of(recordings, step)
    if data is None:
        return False
    columns = {
        "a": data.a[:, k],
        "plain": np.hstack([np.ones((len(data.t), 1)), data.v]),
        "periodic": np.hstack([np.sin(data.q), np.cos(data.q)]),
        "drives": np.hstack([data.u[:, 0], np.sign(data.v)]),
    }
    regression = EquationOfMotionRegression(columns, np.zeros(len(data.t), dtype=int))
    plain, periodic, driven = (
        float(regression.fit("a", x).shares()[0, 0])
        for x in (["plain"], ["plain", "periodic"], ["plain", "drives"])
    )
    return periodic < _PERIODIC * plain or driven < _FREE


def check_rest(splits: Mapping[str, list[Recording]], q: Columns) -> list[Measurement]:
    """Measure the motion of each coordinate in the training, and the share of each split at rest.

    At rest no coordinate moves faster than a hundredth of its fastest motion in the training.
    """
    results, training = [], splits["train"]
    for k, name in enumerate(q.columns):
        spread = np.concatenate([item.q[:, k] for item in training]).std()
        text = f"column {name!r} (q): moves no more than its noise, {spread:.3g} {q.units[k]}"
        measured = ("spread of q in the training", name, spread, "above noise")
        results.append(judged(*measured, not moves(training, k), text))
    steps = {
        name: np.vstack([np.abs(np.diff(item.q, axis=0)) for item in items])
        for name, items in splits.items()
    }
    slow = 0.01 * steps["train"].max(axis=0).clip(min=1e-300)
    for name, sizes in steps.items():
        share, part = (sizes < slow).all(axis=1).mean(), "training" if name == "train" else name
        text = f"the robot is at rest for {100 * share:.0f} % of the {part} samples: "
        if name == "train":
            coverage = wording.setting("data.coverage", 1.0)
            text += f"windows drawn there teach little; use {coverage}, or cut the rest out"
        else:
            text += (
                "errors there tell little of a model; take another part or run for "
                f"{wording.setting(f'dataset.{part}')}"
            )
        stop = name == "train" and share > _ALL_AT_REST
        verdict: Verdict = "stop" if stop else "warning"
        expected, bad = f"below {_AT_REST}", share > _AT_REST
        results.append(judged("share at rest", part, share, expected, bad, text, verdict))
    return results


def check_velocities(
    recordings: Sequence[Recording], q: Columns, v: Columns, step: float
) -> list[Measurement]:
    """Measure the factor k between dq/dt and v, in all runs and in tenths of each stretch.

    Δq_j = k ∫ v dt over 10, 100 and 1000 samples, by least squares; integrals are less noisy than
    derivatives. The number of samples counts over which the two agree best.
    """
    trials = [_products(recordings, step, samples) for samples in (10, 100, 1000)]
    low, high = _FACTORS
    results = []
    for k, (a, b) in enumerate(zip(q.columns, v.columns, strict=True)):
        # Sums of sizes: the sign may change along a run.
        sums = [np.array([np.abs(p[:, k, k]), x[:, k], y[:, k]]).sum(axis=1) for p, x, y in trials]
        best = int(np.argmax([p / max(math.sqrt(x * y), 1e-300) for p, x, y in sums]))
        products, dq, dv = trials[best]
        odd = _odd_tenths(products[:, k, k], dq[:, k], dv[:, k])
        norms = np.sqrt(dq[:, k].sum() * dv.sum(axis=0)).clip(min=1e-300)
        correlations = np.abs(products[:, k].sum(axis=0)) / norms
        match = int(correlations.argmax())
        product, x, y = (z[~odd].sum() for z in (products[:, k, k], dq[:, k], dv[:, k]))
        ratio, correlation = product / max(y, 1e-300), abs(product) / max(math.sqrt(x * y), 1e-300)
        where = cause = ""
        if match != k and correlations[match] >= _CLEAR > correlations[k] and moves(recordings, k):
            cause = f"{v.columns[match]!r} fits it: are columns of v exchanged?"
            correlation = correlations[k]
        elif correlation >= _CLEAR and not low <= ratio <= high:
            wrong = (180 / math.pi, math.pi / 180)
            degrees = any(math.isclose(abs(ratio), x, rel_tol=0.2) for x in wrong)
            cause = "one of them is in degrees" if degrees else "check unit, scale and sign of both"
        elif correlation < _CLEAR and moves(recordings, k):
            cause = "is this the right column?"
        elif odd.any():
            tenths = np.flatnonzero(odd)
            item = recordings[int(tenths[0]) // _TENTHS]
            within = tenths[tenths // _TENTHS == tenths[0] // _TENTHS] % _TENTHS
            edges = np.linspace(item.t[0], item.t[-1], _TENTHS + 1)[[within[0], within[-1] + 1]]
            more = len({recordings[int(i) // _TENTHS].run for i in tenths} - {item.run})
            where = f"{item.run} ({edges[0]:.4g} to {edges[1]:.4g} s)"
            where += f" and {more} more runs, " if more else ", "
            ratio = products[odd, k, k].sum() / max(dv[odd, k].sum(), 1e-300)
            cause = "is v reversed, stuck or in another unit there?"
        text = (
            f"{where}columns {a!r} and {b!r}: the derivative of q is {ratio:.4g} times v, expected "
            f"1, with a correlation of {correlation:.2f}{' elsewhere' if where else ''}: {cause}"
        )
        expected = f"{low} to {high}"
        results.append(judged("dq/dt over v", f"{a}, {b}", ratio, expected, bool(cause), text))
    return results


def check_velocity_lag(
    recordings: Sequence[Recording], q: Columns, v: Columns, step: float
) -> list[Measurement]:
    """Measure the lag of v behind dq/dt, as that of a filter or of another clock."""
    parts = [replace(item, u=item.v) for item in recordings if item.v is not None]
    last = max(2, min(round(_LAGS / step), min(map(len, parts)) // 4))
    lags = np.unique(np.linspace(-last, last, 2 * min(last, 20) + 1).round().astype(int))
    data = Averages.of(parts, step, lags=lags)
    if data is None:
        return []
    results = []
    for k, (a, b) in enumerate(zip(q.columns, v.columns, strict=True)):
        columns = {"v": data.u[:, :, k], "slope": data.v[:, k], "one": np.ones(len(data.t))}
        regression = EquationOfMotionRegression(columns, np.zeros(len(data.t), dtype=int))
        shares = regression.fit("v", ["slope", "one"]).shares()[0]
        best = int(shares.argmin())
        # Lag l of a column means that it is read l samples earlier: a late v needs a negative one.
        lag = -lags[best] * step
        clear = shares[best] < min(_LAGGED * shares[lags == 0][0], 1 - _CLEAR**2)
        bad = bool(clear and abs(lag) > 1.5 * step)
        text = (
            f"column {b!r} is {1e3 * abs(lag):.3g} ms {'behind' if lag > 0 else 'ahead of'} the "
            f"derivative of {a!r}: is it filtered or from another clock? Leave out v (it is then "
            "computed from q), or correct its times"
        )
        results.append(judged("lag of v [ms]", f"{a}, {b}", 1e3 * lag, "0", bad, text))
    return results


def moves(recordings: Sequence[Recording], k: int) -> bool:
    """Tell whether coordinate k moves by more than noise.

    For noise alone the mean square of the steps is twice the variance (von Neumann 1941).
    """
    q = np.concatenate([item.q[:, k] for item in recordings])
    steps = np.concatenate([np.diff(item.q[:, k]) for item in recordings])
    return bool(np.ptp(q) > _STILL and (steps**2).mean() <= q.var())


def _products(
    recordings: Sequence[Recording], step: float, samples: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return sums of Δq ∫v ``(B, N, N)``, Δq² and (∫v)² ``(B, N)`` over tenths of stretches."""
    parts = []
    for item in recordings:
        integral = scipy.integrate.cumulative_trapezoid(item.v, dx=step, axis=0, initial=0)
        stride = max(1, samples // 10)
        dq, dv = (x[samples:][::stride] - x[:-samples][::stride] for x in (item.q, integral))
        tenths = (np.arange(len(dq)) * _TENTHS // max(len(dq), 1))[:, None] == np.arange(_TENTHS)
        sums = ("rb,ri,rj->bij", dq, dv), ("rb,ri,ri->bi", dq, dq), ("rb,ri,ri->bi", dv, dv)
        # Fewer increments are too few to tell.
        enough = len(dq) >= 2 * _TENTHS
        parts.append([enough * np.einsum(form, tenths.astype(float), x, y) for form, x, y in sums])
    products, dq, dv = map(np.concatenate, zip(*parts, strict=True))
    return products, dq, dv


def _odd_tenths(product: np.ndarray, dq: np.ndarray, dv: np.ndarray) -> np.ndarray:
    """Return the tenths that move and whose Δq is not k ∫v, at least two of a stretch, ``(B,)``.

    k is the median of the tenths, with a positive sign unless most of them are negative.
    """
    ratio = np.abs(product) / dv.clip(min=1e-300)
    clear = (np.abs(product) > _CLEAR * np.sqrt(dq * dv)) & (product != 0)
    if not clear.any():
        return clear
    k = np.median(ratio[clear]) * (-1 if np.mean(product[clear] < 0) > 0.75 else 1)
    size = np.maximum(dq, k**2 * dv)
    moving = size > _MOVING * min(dq.mean(), k**2 * dv.mean())
    left = (dq - 2 * k * product + k**2 * dv) / size.clip(min=1e-300)
    odd = (moving & (left > _LEFT)).reshape(-1, _TENTHS)
    # Where most tenths disagree, the columns do.
    odd &= odd.sum(axis=1, keepdims=True) >= 2
    return odd.ravel() & (odd.sum() <= _MOST_ODD * moving.sum())
