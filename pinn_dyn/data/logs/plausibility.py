"""Measurements that tell whether the signals of a log fit together: units, signs, velocities."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np
from scipy.integrate import cumulative_trapezoid

from pinn_dyn.data.logs.checks import BURSTS, burst_share
from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.measurement import Measurement, Verdict, judged
from pinn_dyn.data.logs.recording import Recording

_FACTORS = (0.8, 1.25)  # range of dq/dt over v without a warning
_CLEAR = 0.8  # correlation from which the factor is determined
_AT_REST, _ALL_AT_REST = 0.9, 0.98  # shares of samples at rest of a warning and of a stop
_STILL = 1e-12  # range of a coordinate that does not move, m or rad
_REVERSED = -0.5  # partial correlation of force and acceleration
_MOST_ROWS = 50_000


def check_stamps(recordings: list[Recording], repairs: Collection[str]) -> list[Measurement]:
    """Measure whether stamps come in bursts, as of a logger that empties a buffer."""
    share, run = max((burst_share(item.t), item.run) for item in recordings)
    text = (
        f"{run}: stamps come in bursts, most rows follow the row before within a fifth of the mean "
        "sample time: if no row is missing, use the step examples.cleaning_steps.RowClock"
    )
    bad = share > BURSTS and "bursts" not in repairs
    return [judged("share of rows in bursts", run, share, f"below {BURSTS}", bad, text)]


def check_inputs(training: list[Recording], u: Columns) -> list[Measurement]:
    """Measure the range of each input in the training."""
    ranges = np.ptp(np.vstack([item.u[:, : len(u.columns)] for item in training]), axis=0)
    text = "input {!r} is constant in the training runs: its effect cannot be learned"
    return [
        judged("range of the input", name, size, "above 0", size == 0, text.format(name))
        for name, size in zip(u.columns, ranges, strict=True)
    ]


def check_angles(recordings: list[Recording], q: Columns) -> list[Measurement]:
    """Measure the largest angles; an angle beyond 4 pi rad is probably in degrees."""
    results = []
    for k in (k for k, unit in enumerate(q.units) if unit == "rad"):
        angle, run = max((float(np.abs(item.q[:, k]).max()), item.run) for item in recordings)
        text = (
            f"{run}, column {q.columns[k]!r}: an angle of {angle:.4g} rad is more than two turns: "
            f"is it in degrees? Its unit is configured as {q.unit[k]!r}"
        )
        measured = ("largest angle [rad]", q.columns[k], angle, "below 4 pi")
        results.append(judged(*measured, angle > 4 * math.pi, text))
    return results


def check_rest(training: list[Recording], q: Columns) -> list[Measurement]:
    """Measure the motion of each coordinate, and the share of the training at rest."""
    results = []
    for k, name in enumerate(q.columns):
        spread = np.concatenate([item.q[:, k] for item in training]).std()
        text = f"column {name!r} (q): moves no more than its noise, {spread:.3g} {q.units[k]}"
        measured = ("spread of q in the training", name, spread, "above noise")
        results.append(judged(*measured, not moves(training, k), text))
    steps = np.vstack([np.abs(np.diff(item.q, axis=0)) for item in training])
    share = (steps < 0.01 * steps.max(axis=0).clip(min=1e-300)).all(axis=1).mean()
    text = (
        f"the robot is at rest for {100 * share:.0f} % of the training samples: windows drawn "
        "there teach little; use data.coverage, or cut the rest out"
    )
    verdict: Verdict = "stop" if share > _ALL_AT_REST else "warning"
    expected, bad = f"below {_AT_REST}", share > _AT_REST
    return [*results, judged("share at rest", "training", share, expected, bad, text, verdict)]


def check_velocities(
    training: list[Recording], q: Columns, v: Columns, step: float
) -> list[Measurement]:
    """Measure the factor k between dq/dt and v in the training.

    Δq_j = k ∫ v dt over stretches of 10, 100 and 1000 samples, by least squares; integrals are less
    noisy than derivatives. The stretches count over which the two agree best.
    """
    correlations, factors = _agreement(training, step)
    low, high = _FACTORS
    results = []
    for k, (a, b) in enumerate(zip(q.columns, v.columns, strict=True)):
        correlation, factor = correlations[k, k], factors[k]
        cause = ""
        if correlation >= _CLEAR and not low <= factor <= high:
            wrong = (180 / math.pi, math.pi / 180)
            degrees = any(math.isclose(abs(factor), x, rel_tol=0.2) for x in wrong)
            cause = "one of them is in degrees" if degrees else "check unit, scale and sign of both"
        elif correlation < _CLEAR and moves(training, k):
            match = int(correlations[k].argmax())
            cause = "is this the right column?"
            if correlations[k, match] >= _CLEAR:
                cause = f"{v.columns[match]!r} fits it: are columns of v exchanged?"
        text = (
            f"columns {a!r} and {b!r}: the derivative of q is {factor:.4g} times v, expected 1, "
            f"with a correlation of {correlation:.2f}: {cause}"
        )
        expected = f"{low} to {high}"
        results.append(judged("dq/dt over v", f"{a}, {b}", factor, expected, bool(cause), text))
    return results


def moves(recordings: Sequence[Recording], k: int) -> bool:
    """Tell whether coordinate k moves by more than noise.

    For noise alone the mean square of the steps is twice the variance (von Neumann 1941).
    """
    q = np.concatenate([item.q[:, k] for item in recordings])
    steps = np.concatenate([np.diff(item.q[:, k]) for item in recordings])
    return bool(np.ptp(q) > _STILL and (steps**2).mean() <= q.var())


def _agreement(recordings: list[Recording], step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return correlations of Δq_i with ∫ v_k dt, ``(N, N)``, and the factor of each v_i."""
    correlations, factors = [], []
    for samples in (10, 100, 1000):
        dq = np.vstack([np.diff(item.q[1::samples], axis=0) for item in recordings])
        integrals = [cumulative_trapezoid(item.v, dx=step, axis=0) for item in recordings]
        dv = np.vstack([np.diff(x[::samples], axis=0) for x in integrals])
        squares = (dv**2).sum(axis=0).clip(min=1e-300)
        product = dq.T @ dv * (len(dq) >= 5)  # fewer are too few to tell
        norms = np.sqrt(np.outer((dq**2).sum(axis=0), squares)).clip(min=1e-300)
        correlations.append(np.abs(product) / norms)
        factors.append(np.diag(product) / squares)
    clearest = np.diagonal(correlations, axis1=1, axis2=2).argmax(axis=0)
    return np.max(correlations, axis=0), np.array(factors)[clearest, range(len(clearest))]


def check_force_signs(training: list[Recording], u: Columns, step: float) -> list[Measurement]:
    """Measure whether a force or torque, one per coordinate, pushes forwards.

    The acceleration and input i are both freed of the parts that 1, q, q², sin q, cos q, v and the
    other inputs explain (least squares). A correlation of the remainders below -0.5 is clear.
    """
    size = len(u.columns)
    if training[0].q.shape[1] != size or not set(u.units) <= {"Nm", "N"}:
        return []
    thin = slice(None, None, max(1, sum(map(len, training)) // _MOST_ROWS))
    signals = [x.values()[:, : 3 * size] for x in training]
    rows = [np.hstack([x, np.gradient(x[:, size : 2 * size], step, axis=0)]) for x in signals]
    q, v, forces, a = np.hsplit(np.vstack([x[thin] for x in rows]), 4)
    basis = np.hstack([np.ones((len(q), 1)), q, q**2, np.sin(q), np.cos(q), v])
    results = []
    for k, name in enumerate(u.columns):
        x = np.hstack([basis, np.delete(forces, k, axis=1)])
        y = np.column_stack([a[:, k], forces[:, k]])
        remainders = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
        norm = np.linalg.norm(remainders, axis=0).prod()
        correlation = float(remainders[:, 0] @ remainders[:, 1]) / norm if norm > 0 else 0.0
        text = (
            f"input {name!r} seems to push backwards: it correlates by {correlation:.2f} with what "
            f"else moves coordinate {k + 1}: is its sign reversed?"
        )
        measured = ("correlation of force and acceleration", name, correlation)
        results.append(judged(*measured, f"above {_REVERSED}", correlation < _REVERSED, text))
    return results
