"""Measurements that tell whether the signals of a log fit together: units, signs, velocities."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
import scipy

from pinn_dyn import wording
from pinn_dyn.data.logs.check.checks import held_rows
from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.data.logs.recording import Recording

STATE = "distance of the input from a measured state"
"""Name of the measurement of inputs that are no commands."""
LOST = "share of steps over lost rows"
"""Name of the measurement of rows that a clock of row numbers does not miss."""
_FACTORS = (0.8, 1.25)  # range of dq/dt over v without a warning
_CLEAR = 0.8  # correlation from which the factor is determined
_AT_REST, _ALL_AT_REST = 0.9, 0.98  # shares of samples at rest of a warning and of a stop
_STILL = 1e-12  # range of a coordinate that does not move, m or rad
_TENTHS, _MOST_ODD = 10, 0.6  # parts of a stretch; largest share of parts that disagree
_COPY, _ROWS_LATER = 0.02, 3  # median steps between an input and a state; rows
_LOST, _SURE = 1.6, 0.15  # sample times that pass from row to row; largest deviation of their noise
_OFTEN = 3.0  # rows that lack a row before them over rows that come too early
_MOVING, _LEFT = 0.05, 0.7  # of a tenth: share of the mean square, share of Δq² that k v leaves


def check_inputs(training: list[Recording], q: Columns, u: Columns) -> list[Measurement]:
    """Measure the range of each input in the training, and compare it with the next q."""
    ranges = np.ptp(np.vstack([item.u[:, : len(u.columns)] for item in training]), axis=0)
    text = "input {!r} is constant in the training runs: its effect cannot be learned"
    results = [
        judged("range of the input", name, size, "above 0", size == 0, text.format(name))
        for name, size in zip(u.columns, ranges, strict=True)
    ]
    for i, name in enumerate(u.columns):
        distance, state = _nearest_state(training, q, i)
        measurement = judged(
            name=STATE,
            place=name,
            value=distance,
            expected=f"above {_COPY:g} steps",
            bad=distance < _COPY,
            text=f"input {name!r} is {state}, not a command: any model predicts q from it, and no "
            "controller can use it; log the command that is sent",
            verdict="stop",
        )
        results.append(measurement)
    return results


def _nearest_state(training: list[Recording], q: Columns, i: int) -> tuple[float, str]:
    """Return the distance of input i from the nearest column of q or v, and the name of this state.

    The distance is the median one to a line a + b x of the state x, in the same row or up to three
    rows later, over the median step of the input.
    """
    moving = [item for item in training if len(item) > 2 * _ROWS_LATER]
    u = np.concatenate([item.u[:-_ROWS_LATER, i] for item in moving] or [np.zeros(1)])
    steps = np.abs(np.concatenate([np.diff(item.u[:, i]) for item in training]))
    if not steps.any():
        return np.inf, ""
    usual = np.median(steps[steps > 0])
    best = np.inf, ""
    for signal in ("q", "v") if training[0].v is not None else ("q",):
        for k, lag in itertools.product(range(len(q.columns)), range(_ROWS_LATER + 1)):
            parts = [getattr(x, signal)[lag : len(x) - _ROWS_LATER + lag, k] for x in moving]
            state = np.concatenate(parts or [np.zeros(1)])
            slope = ((state - state.mean()) * (u - u.mean())).mean() / max(state.var(), 1e-300)
            left = u - u.mean() - slope * (state - state.mean())
            distance = float(np.median(np.abs(left)) / usual)
            if distance < best[0]:
                row = ("the same row", "the next row", f"{lag} rows later")[min(lag, 2)]
                name = f"{q.columns[k]!r}" if signal == "q" else f"the speed of {q.columns[k]!r}"
                best = distance, f"{name} of {row}" if lag < 2 else f"{name}, {row}"
    return best


def check_rest(splits: Mapping[str, list[Recording]], q: Columns) -> list[Measurement]:
    """Measure the motion of each coordinate in the training, and the share of each split at rest.

    At rest no coordinate moves faster than a hundredth of its fastest motion in the training.
    """
    training = splits["train"]
    results = [_spread(training, k, name, q.units[k]) for k, name in enumerate(q.columns)]
    rows = max(held_rows(item.q) for item in training)  # held values do not move row by row
    steps = {
        name: np.vstack([np.abs(item.q[rows:] - item.q[:-rows]) for item in items])
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
        measurement = judged(
            name="share at rest",
            place=part,
            value=share,
            expected=f"below {_AT_REST}",
            bad=share > _AT_REST,
            text=text,
            verdict="stop" if name == "train" and share > _ALL_AT_REST else "warning",
        )
        results.append(measurement)
    return results


def _spread(training: Sequence[Recording], k: int, name: str, unit: str) -> Measurement:
    spread = np.concatenate([item.q[:, k] for item in training]).std()
    return judged(
        name="spread of q in the training",
        place=name,
        value=spread,
        expected="above noise",
        bad=not moves(training, k),
        text=f"column {name!r} (q): moves no more than its noise, {spread:.3g} {unit}",
    )


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
        measurement = judged(
            name="dq/dt over v",
            place=f"{a}, {b}",
            value=ratio,
            expected=f"{low} to {high}",
            bad=len(cause) > 0,
            text=f"{where}columns {a!r} and {b!r}: the derivative of q is {ratio:.4g} times v, "
            f"expected 1, with a correlation of {correlation:.2f}{' elsewhere' if where else ''}: "
            f"{cause}",
        )
        results.append(measurement)
    return results


def check_lost_rows(recordings: Sequence[Recording], q: Columns) -> list[Measurement]:
    """Measure the share of rows before which rows are missing, by Δq = v Δt in single steps.

    A clock of row numbers does not see them. The time that passes from row to row is that of all
    joints together, Δt = Σ v_j Δq_j / σ_j² / Σ v_j² / σ_j².
    """
    passed, inside = [], []
    for item in recordings:
        assert item.v is not None
        step = np.diff(item.t)[:, None]
        dq, expected = np.diff(item.q, axis=0), step * (item.v[1:] + item.v[:-1]) / 2
        noise = 1.4826 * np.median(np.abs(dq - expected), axis=0)
        noise = np.maximum(noise, 0.02 * np.sqrt((expected**2).mean(axis=0))).clip(min=1e-150)
        weight = ((expected / noise) ** 2).sum(axis=1)
        moving = (np.abs(item.v) * np.median(step) > noise).any(axis=1)
        sure = weight > 1 / _SURE**2
        inside.append((moving[1:] & moving[:-1])[sure])
        passed.append((dq * expected / noise**2).sum(axis=1)[sure] / weight[sure])
    times = np.concatenate(passed)
    late = (times > _LOST) & np.concatenate(inside)  # not at a stop by a brake
    whole = np.abs(times - times.round())[late] < 0.25
    lost, early = int(late.sum()), int((times < 2 - _LOST).sum())
    bad = lost >= 5 and lost > _OFTEN * early and whole.mean() > 0.8
    share = lost / max(len(times), 1)
    measurement = judged(
        name=LOST,
        place=", ".join(q.columns),
        value=share,
        expected="0, or no whole sample times",
        bad=bool(bad),
        text=f"in {100 * share:.2g} % of the steps q moves as far as v does in two or more sample "
        "times: rows are lost, and the clock counts the rows that are left; log the times of the "
        "samples",
    )
    return [measurement]


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
