"""Measurements that tell whether the signals of a log fit together: units, signs, velocities."""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from pinn_dyn.data.logs.checks import BURSTS, burst_share
from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.data.logs.recording import Recording

# Factor between dq/dt and v without a warning, and the correlation that determines it.
_FACTORS = (0.8, 1.25)
_CLEAR = 0.8
# The same factor of a single run, which noise in its v makes smaller.
_FACTORS_OF_A_RUN = (0.5, 2.0)
# Share of the samples in which a robot may rest without a warning.
_AT_REST = 0.9
# A coordinate that moves less, m or rad, does not move.
_STILL = 1e-12
# A partial correlation of force and acceleration below this value is clear.
_REVERSED = -0.5
# All columns of a signal are larger in one run: motions do not do that, degrees (57) or mm do.
_OTHER_UNITS = 40.0
_MOST_ROWS = 50_000


def check_stamps(recordings: list[Recording], repairs: Collection[str]) -> list[Measurement]:
    """Measure whether stamps come in bursts, as of a logger that empties a buffer."""
    shares = [burst_share(item.t) for item in recordings]
    worst = int(np.argmax(shares))
    bad = shares[worst] > BURSTS and "bursts" not in repairs
    run = recordings[worst].run
    text = (
        f"{run}: stamps come in bursts, most rows follow the row before within a fifth of the mean "
        "sample time: if no row is missing, take the time from the row number, by the step "
        "examples.cleaning_steps.RowClock"
    )
    return [judged("share of rows in bursts", run, shares[worst], f"below {BURSTS}", bad, text)]


def check_inputs(training: list[Recording], u: Columns) -> list[Measurement]:
    """Measure the range of each input in the training.

    Raises:
        LogError: if no input ever changes.
    """
    sizes = np.ptp(np.vstack([item.u[:, : len(u.columns)] for item in training]), axis=0)
    if not sizes.any():
        raise LogError(
            f"u: every input ({', '.join(u.columns)}) is constant in the training runs: are these "
            "the right columns?"
        )
    results = []
    for name, size in zip(u.columns, sizes, strict=True):
        text = f"input {name!r} is constant in the training runs: its effect cannot be learned"
        results.append(judged("range of the input", name, size, "above 0", size == 0, text))
    return results


def check_angles(recordings: list[Recording], q: Columns) -> list[Measurement]:
    """Measure the largest angles; an angle beyond 4 pi rad is probably in degrees."""
    results = []
    for k, name in enumerate(q.columns):
        if q.units[k] != "rad":
            continue
        largest = [float(np.abs(item.q[:, k]).max()) for item in recordings]
        run, value = recordings[int(np.argmax(largest))].run, max(largest)
        text = (
            f"{run}, column {name!r}: an angle of {value:.4g} rad is more than two turns: is it in "
            f"degrees? Its unit is configured as {q.unit[k]!r}"
        )
        results.append(
            judged(
                "largest angle [rad]",
                name,
                value,
                "below 4 pi",
                value > 4 * math.pi,
                text,
                section="csv_logs.md#columns",
            )
        )
    return results


def check_units_of_runs(
    recordings: list[Recording], signals: Mapping[str, Columns]
) -> list[Measurement]:
    """Warn of runs, of three or more, in which all columns of a signal spread far too much."""
    results = []
    for signal in signals if len(recordings) >= 3 else ():
        spreads = np.array([getattr(item, signal).std(axis=0) for item in recordings])
        usual = np.sort(spreads, axis=0)[(len(spreads) - 1) // 2]
        for item, spread in zip(recordings, spreads, strict=True):
            if (usual > 0).all() and (spread > _OTHER_UNITS * usual).all():
                ratio = (spread / usual).min()
                text = (
                    f"{item.run}: {signal} spreads {ratio:.3g} times as far as in most runs: has "
                    "this run other units?"
                )
                name = f"spread of {signal} beside most runs"
                results.append(judged(name, item.run, ratio, f"below {_OTHER_UNITS:g}", True, text))
    return results


def check_rest(training: list[Recording], q: Columns) -> list[Measurement]:
    """Measure the motion of each coordinate, and the share of the training at rest.

    Raises:
        LogError: if no coordinate ever moves.
    """
    positions = np.vstack([item.q for item in training])
    still = np.ptp(positions, axis=0) <= _STILL
    if still.all():
        raise LogError(
            f"q: no coordinate ({', '.join(q.columns)}) moves in the training runs: there is no "
            "motion to learn from; are these the right columns?"
        )
    results = []
    for k, name in enumerate(q.columns):
        spread = positions[:, k].std()
        text = ""
        if still[k]:
            text = f"column {name!r} (q): never moves in the training runs"
        elif not moves(training, k):
            text = (
                f"column {name!r} (q): moves no more than its noise in the training runs, "
                f"{spread:.3g} {q.units[k]}"
            )
        results.append(
            judged("spread of q in the training", name, spread, "above noise", bool(text), text)
        )
    steps = np.vstack([np.abs(np.diff(item.q, axis=0)) for item in training])
    slow = (x < 0.01 * max(x.max(), 1e-300) for x in steps.T)
    share = float(functools.reduce(np.logical_and, slow).mean())
    text = (
        f"the robot is at rest for {100 * share:.0f} % of the training samples: windows drawn "
        "there teach little; use data.coverage, or cut the rest out"
    )
    results.append(
        judged("share at rest", "training", share, f"below {_AT_REST}", share > _AT_REST, text)
    )
    return results


def check_velocities(
    parts: Mapping[str, list[Recording]], q: Columns, v: Columns, step: float
) -> list[Measurement]:
    """Measure the factor k between dq/dt and v, of the training and of each run.

    Δq_j = k ∫ v dt over stretches of 10, 100 and 1000 samples, by least squares; integrals are less
    noisy than derivatives. The stretches count over which the two agree best.

    Args:
        parts: the stretches of training, validation and test.
        q, v: their columns.
        step: the sample time, s.
    """
    training = parts["train"]
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
    return results + _velocities_of_runs(parts, q, v, step)


def _velocities_of_runs(
    parts: Mapping[str, list[Recording]], q: Columns, v: Columns, step: float
) -> list[Measurement]:
    """Warn of single runs whose v has another unit or sign than that of most runs."""
    runs: dict[str, list[Recording]] = {}
    for split, stretches in parts.items():
        for item in stretches:
            runs.setdefault(f"{item.run} ({split})", []).append(item)
    rows = []
    for stretches in runs.values():
        correlations, values = _agreement(stretches, step)
        clear = np.diag(correlations) >= _CLEAR
        for k in range(len(values)):
            zero = not any(x.v[:, k].any() for x in stretches if x.v is not None)
            clear[k] |= zero and moves(stretches, k)
        rows.append(np.where(clear, values, np.nan))
    low, high = _FACTORS_OF_A_RUN
    results = []
    for a, b, factors in zip(q.columns, v.columns, np.transpose(rows), strict=True):
        usual = float(np.median(factors[~np.isnan(factors)])) if not np.isnan(factors).all() else 0
        for run, factor in zip(runs, factors, strict=True):
            if not np.isnan(factor) and not low * usual**2 <= factor * usual <= high * usual**2:
                place = f"{run}, columns {a!r} and {b!r}"
                text = (
                    f"{place}: the derivative of q is {factor:.4g} times v in this run (0: v is "
                    f"zero), and {usual:.4g} times in most: has it other units or signs?"
                )
                results.append(judged("dq/dt over v", place, factor, f"{usual:.3g}", True, text))
    return results


def moves(recordings: Sequence[Recording], k: int) -> bool:
    """Tell whether coordinate k moves by more than noise.

    For noise alone the mean square of the steps is twice the variance (von Neumann 1941).
    """
    q = np.concatenate([item.q[:, k] for item in recordings])
    steps = np.concatenate([np.diff(item.q[:, k]) for item in recordings])
    return bool(np.ptp(q) > 0 and (steps**2).mean() <= q.var())


def _agreement(recordings: list[Recording], step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return correlations of Δq_i with ∫ v_k dt, ``(N, N)``, and the factor of each v_i."""
    results = [_agreement_over(recordings, step, samples) for samples in (10, 100, 1000)]
    correlations, factors = (np.array(values) for values in zip(*results, strict=True))
    diagonal = correlations.diagonal(axis1=1, axis2=2)
    return correlations.max(axis=0), factors[diagonal.argmax(axis=0), range(diagonal.shape[1])]


def _agreement_over(
    recordings: list[Recording], step: float, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the same over stretches of so many samples."""
    size = recordings[0].q.shape[1]
    dq, dv = [np.zeros((0, size))], [np.zeros((0, size))]
    for item in recordings:
        assert item.v is not None
        integral = np.cumsum(0.5 * step * (item.v[1:] + item.v[:-1]), axis=0)
        dq.append(np.diff(item.q[1::samples], axis=0))
        dv.append(np.diff(integral[::samples], axis=0))
    moved, integrated = np.vstack(dq), np.vstack(dv)
    squares = (integrated**2).sum(axis=0)
    norms = np.sqrt(np.outer((moved**2).sum(axis=0), squares))
    product = moved.T @ integrated * (len(moved) >= 5)  # fewer are too few to tell
    correlations = np.abs(product) / np.where(norms > 0, norms, np.inf)
    return correlations, np.diag(product) / np.where(squares > 0, squares, np.inf)


def check_force_signs(training: list[Recording], u: Columns, step: float) -> list[Measurement]:
    """Measure whether a force or torque, one per coordinate, pushes forwards.

    The acceleration and input i are both freed of the parts that 1, q, q², sin q, cos q, v and the
    other inputs explain (least squares). A correlation of the remainders below -0.5 is clear.
    """
    size = len(u.columns)
    if training[0].q.shape[1] != size or not set(u.units) <= {"Nm", "N"}:
        return []
    # A sample tells, and all of a long log would take gigabytes.
    thin = slice(None, None, max(1, sum(map(len, training)) // _MOST_ROWS))
    q = np.vstack([item.q[thin] for item in training])
    v = np.vstack([item.v[thin] for item in training if item.v is not None])
    forces = np.vstack([item.u[thin, :size] for item in training])  # without rates of the inputs
    acceleration = np.vstack(
        [np.gradient(item.v, step, axis=0)[thin] for item in training if item.v is not None]
    )
    ones = np.ones((len(q), 1))
    results = []
    for k, name in enumerate(u.columns):
        inputs = np.delete(forces, k, axis=1)
        known = np.hstack([ones, q, q**2, np.sin(q), np.cos(q), v, inputs])
        both = np.column_stack([acceleration[:, k], forces[:, k]])
        remainders = both - known @ np.linalg.lstsq(known, both, rcond=None)[0]
        norm = np.linalg.norm(remainders, axis=0).prod()
        correlation = float(remainders[:, 0] @ remainders[:, 1]) / norm if norm > 0 else 0.0
        text = (
            f"input {name!r} seems to push backwards: it correlates with the acceleration of "
            f"coordinate {k + 1} by {correlation:.2f} once position, velocity and other inputs "
            "are accounted for: is its sign reversed?"
        )
        results.append(
            judged(
                "correlation of force and acceleration",
                name,
                correlation,
                f"above {_REVERSED}",
                correlation < _REVERSED,
                text,
            )
        )
    return results
