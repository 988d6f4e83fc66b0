"""Measurements that tell whether the signals of a log fit together: units, signs, velocities."""

from __future__ import annotations

import functools
import itertools
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
# Share that v leaves unexplained of the steps of q: of bad stamps, and of a uniform clock.
_STAMPS_FAIL = 0.1
_ROWS_AGREE = 0.25
# A coordinate that moves less, m or rad, does not move.
_STILL = 1e-12
# A partial correlation of force and acceleration below this value is clear.
_REVERSED = -0.5
# Signals that correlate more strongly are equal but for rounding.
_EQUAL = 1 - 1e-9
# All columns of a signal are larger in one run: motions do not do that, degrees (57) or mm do.
_OTHER_UNITS = 40.0
_MOST_ROWS = 50_000


def check_stamps(recordings: list[Recording], repairs: Collection[str]) -> list[Measurement]:
    """Measure whether stamps come in bursts, or contradict q and v where row numbers do not.

    By the stamps q moves by v (t_{k+1} - t_k) from row to row, by a uniform clock by v h. The share
    of the squares of the steps of q that either leaves, by least squares, tells which is right.
    """
    long = [item for item in recordings if len(item) > 20 and item.t[-1] > item.t[0]]
    if "bursts" in repairs or not long:
        return []
    cure = (
        "if no row is missing, take the time from the row number, by the step "
        "examples.cleaning_steps.RowClock"
    )
    shares = [burst_share(item.t) for item in long]
    worst = int(np.argmax(shares))
    bursts = (
        f"{long[worst].run}: stamps come in bursts, most rows follow the row before within a fifth "
        f"of the mean sample time: {cure}"
    )
    results = [
        judged(
            "share of rows in bursts",
            long[worst].run,
            shares[worst],
            f"below {BURSTS}",
            shares[worst] > BURSTS,
            bursts,
        )
    ]
    if results[0].verdict != "ok" or long[0].v is None:
        return results
    stamped = np.concatenate([np.diff(item.t) for item in long])
    uniform = np.concatenate(
        [np.full(len(item) - 1, item.duration / (len(item) - 1)) for item in long]
    )
    for k in range(long[0].q.shape[1]):
        steps = np.concatenate([np.diff(item.q[:, k]) for item in long])
        speed = np.concatenate(
            [0.5 * (item.v[1:, k] + item.v[:-1, k]) for item in long if item.v is not None]
        )
        by_stamps, by_rows = (_unexplained(steps, speed * h) for h in (stamped, uniform))
        if by_stamps > _STAMPS_FAIL and by_rows < _ROWS_AGREE * by_stamps:
            text = (
                f"coordinate {k + 1}: by the stamps v leaves {100 * by_stamps:.0f} % of the steps "
                f"of q unexplained, by a uniform clock {100 * by_rows:.2g} %: the stamps are not "
                f"the times of the samples; {cure}"
            )
            results.append(
                judged("steps of q that v and stamps leave", str(k + 1), by_stamps, "0", True, text)
            )
    return results


def _unexplained(y: np.ndarray, x: np.ndarray) -> float:
    """Return the share of the squares of y that a multiple of x leaves."""
    return 1 - float((x @ y) ** 2 / max((x @ x) * (y @ y), 1e-300))


def check_inputs(recordings: list[Recording], u: Columns) -> list[Measurement]:
    """Measure the range of each input; an input that never changes is a warning.

    Raises:
        LogError: if no input ever changes.
    """
    low, high = (
        function([function(item.u, axis=0) for item in recordings], axis=0)
        for function in (np.min, np.max)
    )
    if (low == high).all():
        raise LogError(
            f"u: every input ({', '.join(u.columns)}) is constant in all runs, so nothing can be "
            "learned about the input matrix: are these the right columns?"
        )
    return [
        judged(
            "range of the input",
            name,
            size,
            "above 0",
            size == 0,
            f"input {name!r} is constant in all runs: its column of A cannot be learned",
        )
        for name, size in zip(u.columns, high - low, strict=True)
    ]


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


def check_equal_signals(
    recordings: list[Recording], signals: Mapping[str, Columns]
) -> list[Measurement]:
    """Warn of two columns that are the same signal but for a factor and an offset."""
    thin = slice(None, None, max(1, sum(map(len, recordings)) // _MOST_ROWS))
    names = [(signal, name) for signal, columns in signals.items() for name in columns.columns]
    values = np.hstack(
        [np.vstack([getattr(item, signal)[thin] for item in recordings]) for signal in signals]
    )
    if len(values) < 100:  # too few to tell
        return []
    values = values - values.mean(axis=0)
    lengths = np.linalg.norm(values, axis=0)
    products = np.abs(values.T @ values)
    results = []
    for i, j in itertools.combinations(range(len(names)), 2):
        if lengths[i] and lengths[j] and products[i, j] > _EQUAL * lengths[i] * lengths[j]:
            (first, a), (second, b) = names[i], names[j]
            inputs = first == second == "u"
            text = (
                f"columns {a!r} ({first}) and {b!r} ({second}) are the same signal but for a "
                "factor: "
                + ("their columns of A cannot be told apart" if inputs else "is one the wrong one?")
            )
            correlation = products[i, j] / (lengths[i] * lengths[j])
            results.append(judged("correlation", f"{a}, {b}", correlation, "below 1", True, text))
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


def check_unseen_inputs(
    training: list[Recording], tests: list[Recording], u: Columns
) -> list[Measurement]:
    """Warn of inputs that stand still in the training runs and move in the validation or test."""
    first = training[0].u[0]
    results = []
    for k, name in enumerate(u.columns):
        still = all((item.u[:, k] == first[k]).all() for item in training)
        moved = [item.run for item in tests if (item.u[:, k] != first[k]).any()]
        if still and moved:
            text = (
                f"column {name!r} (u): is {first[k]:.4g} {u.units[k]} in all training runs and "
                f"moves in {moved[0]}: its effect cannot be learned"
            )
            results.append(judged("range in the training", name, 0.0, "above 0", True, text))
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
        place = f"columns {a!r} and {b!r}"
        text = ""
        if correlation >= _CLEAR and not low <= factor <= high:
            degrees = any(
                math.isclose(abs(factor), wrong, rel_tol=0.2)
                for wrong in (180 / math.pi, math.pi / 180)
            )
            cause = "one of them is in degrees" if degrees else "check unit, scale and sign of both"
            text = f"{place}: the derivative of q is {factor:.4g} times v, expected 1: {cause}"
        elif correlation < _CLEAR and moves(training, k):
            match = int(correlations[k].argmax())
            zero = all(not item.v[:, k].any() for item in training if item.v is not None)
            cause = "v is zero throughout" if zero else "is this the right column?"
            if correlations[k, match] >= _CLEAR:
                cause = f"{v.columns[match]!r} fits it: are columns of v exchanged?"
            text = (
                f"{place}: v is not the derivative of q, their correlation is {correlation:.2f}, "
                f"expected nearly 1: {cause}"
            )
        results.append(
            judged("dq/dt over v", f"{a}, {b}", factor, f"{low} to {high}", bool(text), text)
        )
    return results + _velocities_of_runs(parts, q, v, step)


def _velocities_of_runs(
    parts: Mapping[str, list[Recording]], q: Columns, v: Columns, step: float
) -> list[Measurement]:
    """Warn of single runs whose v has another unit or sign than that of most runs."""
    runs: dict[tuple[str, str], list[Recording]] = {}
    for split, stretches in parts.items():
        for item in stretches:
            runs.setdefault((item.run, split), []).append(item)
    agreements = [_agreement(stretches, step) for stretches in runs.values()]
    factors = np.array([np.where(np.diag(c) >= _CLEAR, f, np.nan) for c, f in agreements])
    low, high = _FACTORS_OF_A_RUN
    results = []
    for k, (a, b) in enumerate(zip(q.columns, v.columns, strict=True)):
        clear = factors[~np.isnan(factors[:, k]), k]
        if not len(clear):  # the training as a whole has a warning
            continue
        usual = float(np.median(clear))
        for ((run, split), stretches), factor in zip(runs.items(), factors[:, k], strict=True):
            place = f"{run} ({split}), columns {a!r} and {b!r}"
            zero = not any(item.v[:, k].any() for item in stretches if item.v is not None)
            text = ""
            if zero and moves(stretches, k):
                text = f"{place}: v is zero throughout this run, while q moves"
            elif not np.isnan(factor) and not low <= factor / usual <= high:
                text = (
                    f"{place}: the derivative of q is {factor:.4g} times v in this run, and "
                    f"{usual:.4g} times in most: has it other units or signs?"
                )
            if text:
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
