"""What looks wrong in a log: errors where it cannot be used, warnings where it may be right."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping

import numpy as np

from pinn_dyn.data.logs.clock import (
    GAP_FACTOR,
    Deduplicate,
    Resample,
    RowClock,
    SplitGaps,
    burst_share,
)
from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording, Report
from pinn_dyn.data.logs.step import Step
from pinn_dyn.data.logs.table import Table

# Logs of robots are written between 2 Hz and 100 kHz.
_SAMPLE_TIMES = (1e-5, 0.5)
# What factor between dq/dt and v needs no warning, and the correlation that determines it.
_FACTORS = (0.8, 1.25)
_CLEAR = 0.8
# The factor of one run alone, which noise in its v makes smaller.
_FACTORS_OF_A_RUN = (0.5, 2.0)
# Share of the samples in which a robot may rest without a warning.
_AT_REST = 0.9
# Share of rows right after the one before from which stamps come in bursts.
_BURSTS = 0.4
# What v leaves unexplained of the steps of q: of bad stamps, and of a clock that is right.
_STAMPS_FAIL = 0.1
_ROWS_AGREE = 0.25
# A coordinate that moves less, m or rad, does not move.
_STILL = 1e-12
# A partial correlation of force and acceleration below this is clear.
_REVERSED = -0.5
_MOST_ROWS = 50_000


def check_clock(t: np.ndarray, table: Table, name: str, steps: list[Step]) -> None:
    """Check the times of one run, in s.

    Raises:
        LogError: on an implausible sample time, and on times that go back, repeat or jump where no
            step takes care of it; names the line and the step.
    """
    if len(t) < 2:
        raise LogError(f"{table.place(0)}: a run of one row, expected at least two")
    spacing = np.diff(t)
    kinds = {type(step) for step in steps}
    back = spacing < 0
    if back.any() and SplitGaps not in kinds:
        k = int(back.argmax())
        raise LogError(
            f"{table.place(k + 1, name)}: the time goes back from {t[k]:.9g} to "
            f"{t[k + 1]:.9g} s: if a new run starts there, name its column in 'trajectory' "
            "(run=... of pinn_dyn.fit) or add a SplitGaps step; otherwise repair the log"
        )
    repeated = spacing == 0
    bursts = burst_share(t) > _BURSTS
    if repeated.any() and not kinds & {Deduplicate, RowClock}:
        k = int(repeated.argmax())
        cure = "add a Deduplicate step, which keeps the first"
        if bursts:
            cure = (
                "its stamps come in bursts of rows: add a RowClock step, which takes the time "
                "from the row number, or Deduplicate, which keeps the first row of a burst"
            )
        raise LogError(
            f"{table.place(k + 1, name)}: the time {t[k]:.9g} s repeats "
            f"({int(repeated.sum())} rows do): {cure}"
        )
    forward = spacing[spacing > 0]
    if not len(forward):
        raise LogError(f"{table.name}, column {name!r}: the time never increases, expected a clock")
    typical = float(spacing.mean() if RowClock in kinds else np.median(forward))
    low, high = _SAMPLE_TIMES
    if not low <= typical <= high:
        raise LogError(
            f"{table.name}, column {name!r}: the sample time would be {typical:.6g} s, expected "
            f"{low:g} to {high:g} s: is the unit of the time wrong "
            f"({'ms' if typical > high else 's'}?)"
        )
    gaps = spacing > GAP_FACTOR * typical
    if gaps.any() and not kinds & {SplitGaps, Resample, RowClock}:
        k = int(gaps.argmax())
        cure = "a SplitGaps step to split the run there, or Resample to interpolate over short gaps"
        if bursts:
            cure = "a RowClock step: its stamps come in bursts of rows"
        raise LogError(
            f"{table.place(k + 1, name)}: the time jumps from {t[k]:.9g} to "
            f"{t[k + 1]:.9g} s, where {typical:.6g} s is usual ({int(gaps.sum())} such gaps): add "
            f"{cure}"
        )


def check_stamps(recordings: list[Recording], steps: list[Step], report: Report) -> None:
    """Warns of stamps that come in bursts, or contradict q and v where the row numbers do not.

    By the stamps q moves by v (t_{k+1} - t_k) from row to row, by a uniform clock by v h. The share
    of the squares of the steps of q that either leaves, by least squares, tells which is right.
    """
    if any(isinstance(step, RowClock) for step in steps):
        return
    long = [item for item in recordings if len(item) > 20 and item.t[-1] > item.t[0]]
    bursts = [item.run for item in long if burst_share(item.t) > _BURSTS]
    if bursts:
        report.warn(
            f"{bursts[0]}{' and others' if len(bursts) > 1 else ''}: stamps come in bursts, most "
            "rows follow the one before within a fifth of the mean sample time: if no row is "
            "missing, a RowClock step takes the time from the row number"
        )
    moved = [item for item in long if item.v is not None]
    if bursts or not moved:
        return
    stamped = np.concatenate([np.diff(item.t) for item in moved])
    uniform = np.concatenate(
        [np.full(len(item) - 1, item.duration / (len(item) - 1)) for item in moved]
    )
    for k in range(moved[0].q.shape[1]):
        moves_by = np.concatenate([np.diff(item.q[:, k]) for item in moved])
        speed = np.concatenate(
            [0.5 * (item.v[1:, k] + item.v[:-1, k]) for item in moved if item.v is not None]
        )
        by_stamps, by_rows = (_unexplained(moves_by, speed * h) for h in (stamped, uniform))
        if by_stamps > _STAMPS_FAIL and by_rows < _ROWS_AGREE * by_stamps:
            report.warn(
                f"coordinate {k + 1}: by the stamps v leaves {100 * by_stamps:.0f} % of the steps "
                f"of q unexplained, by a uniform clock {100 * by_rows:.2g} %: the stamps are not "
                "the times of the samples; if no row is missing, add a RowClock step"
            )


def _unexplained(y: np.ndarray, x: np.ndarray) -> float:
    """Share of the squares of y that a multiple of x leaves."""
    return 1 - float((x @ y) ** 2 / max((x @ x) * (y @ y), 1e-300))


def check_second_clock(
    t: np.ndarray, other: np.ndarray, table: Table, names: tuple[str, str]
) -> None:
    """Two time columns of one run, in s, which must elapse alike.

    Raises:
        LogError: where they are more than a typical sample time apart; names the line.
    """
    typical = float(np.median(np.abs(np.diff(t))))
    apart = np.abs((t - t[0]) - (other - other[0]))
    if (apart > typical).any():
        k = int((apart > typical).argmax())
        raise LogError(
            f"{table.place(k)}: the clocks {names[0]!r} and {names[1]!r} disagree: "
            f"{t[k] - t[0]:.9g} and {other[k] - other[0]:.9g} s have passed since the start of the "
            f"run, and {apart.max():.4g} s is the most they are apart: check their units, and "
            "keep the clock of the robot alone"
        )


def check_inputs(recordings: list[Recording], u: Columns, report: Report) -> None:
    """Warns of inputs that never change.

    Raises:
        LogError: if no input ever changes.
    """
    first = recordings[0].u[0]
    moved = np.any([(recording.u != first).any(axis=0) for recording in recordings], axis=0)
    still = [name for name, moves in zip(u.columns, moved, strict=True) if not moves]
    if len(still) == len(u.columns):
        raise LogError(
            f"u: every input ({', '.join(still)}) is constant in all runs, so nothing can be "
            "learned about the input matrix: are these the right columns?"
        )
    for name in still:
        report.warn(f"input {name!r} is constant in all runs: its column of A cannot be learned")


def check_angles(recordings: list[Recording], q: Columns, report: Report) -> None:
    """Warns of angles beyond 4 pi rad, which are probably in degrees."""
    for k, name in enumerate(q.columns):
        if q.units[k] != "rad":
            continue
        for recording in recordings:
            largest = float(np.abs(recording.q[:, k]).max())
            if largest > 4 * math.pi:
                row = int(np.abs(recording.q[:, k]).argmax())
                report.warn(
                    f"{recording.run}, column {name!r}: {largest:.4g} rad at t = "
                    f"{recording.t[row]:.6g} s is more than two turns: is it in degrees? Its unit "
                    f"is given as {q.file_units[k]!r}"
                )
                break


def check_rest(training: list[Recording], q: Columns, report: Report) -> None:
    """Warns of coordinates that never move or move no more than their noise, and of long rest.

    Raises:
        LogError: if no coordinate ever moves.
    """
    every = [np.concatenate([item.q[:, k] for item in training]) for k in range(len(q.columns))]
    still = [np.ptp(values) <= _STILL for values in every]
    if all(still):
        raise LogError(
            f"q: no coordinate ({', '.join(q.columns)}) moves in the training runs: there is no "
            "motion to learn from; are these the right columns?"
        )
    for k, name in enumerate(q.columns):
        if still[k]:
            report.warn(f"column {name!r} (q): never moves in the training runs")
        elif not moves(training, k):
            report.warn(
                f"column {name!r} (q): moves no more than its noise in the training runs, "
                f"{every[k].std():.3g} {q.units[k]}"
            )
    speeds = (
        np.concatenate([np.abs(np.diff(item.q[:, k])) for item in training])
        for k in range(len(q.columns))
    )
    slow = (speed < 0.01 * max(speed.max(), 1e-300) for speed in speeds)
    share = float(functools.reduce(np.logical_and, slow).mean())
    if share > _AT_REST:
        report.warn(
            f"the robot is at rest for {100 * share:.0f} % of the training samples: windows drawn "
            "there teach little; use data.coverage, or cut the rest out"
        )


def check_unseen_inputs(
    training: list[Recording], others: list[Recording], u: Columns, report: Report
) -> None:
    """Warns of inputs that stand still in the training runs and move in the others."""
    first = training[0].u[0]
    for k, name in enumerate(u.columns):
        still = all((item.u[:, k] == first[k]).all() for item in training)
        moved = [item.run for item in others if (item.u[:, k] != first[k]).any()]
        if still and moved:
            report.warn(
                f"column {name!r} (u): is {first[k]:.4g} {u.units[k]} in all training runs and "
                f"moves in {moved[0]}: what it does there cannot be learned"
            )


def check_velocities(
    training: list[Recording], q: Columns, v: Columns, step: float, report: Report
) -> None:
    """Warns where v is not the derivative of q: by a factor k, or not at all.

    Δq_j = k ∫ v dt over stretches of 10, 100 and 1000 samples, by least squares; integrals are less
    noisy than derivatives. The stretches count over which the two agree best.
    """
    names = [f"columns {a!r} and {b!r}" for a, b in zip(q.columns, v.columns, strict=True)]
    correlations, factors = _agreement(training, step)
    for k, name in enumerate(names):
        correlation, factor = correlations[k, k], factors[k]
        if correlation >= _CLEAR and _FACTORS[0] <= factor <= _FACTORS[1]:
            continue
        if correlation >= _CLEAR:
            degrees = any(
                math.isclose(abs(factor), wrong, rel_tol=0.2)
                for wrong in (180 / math.pi, math.pi / 180)
            )
            cause = "one of them is in degrees" if degrees else "check unit, scale and sign of both"
            report.warn(f"{name}: the derivative of q is {factor:.4g} times v, expected 1: {cause}")
        elif moves(training, k):
            other = int(correlations[k].argmax())
            zero = all(not item.v[:, k].any() for item in training if item.v is not None)
            cause = "v is zero throughout" if zero else "is this the right column?"
            if correlations[k, other] >= _CLEAR and other != k:
                cause = f"{v.columns[other]!r} fits it: are columns of v exchanged?"
            report.warn(
                f"{name}: v is not the derivative of q, their correlation is {correlation:.2f}, "
                f"expected nearly 1: {cause}"
            )


def check_velocities_of_runs(
    parts: Mapping[str, list[Recording]], q: Columns, v: Columns, step: float, report: Report
) -> None:
    """Warns of single runs whose v has another unit or sign than that of most runs.

    Args:
        parts: the stretches of training, validation and test.
        q, v: their columns.
        step: the sample time, s.
        report: takes the warnings.
    """
    runs: dict[tuple[str, str], list[Recording]] = {}
    for split, stretches in parts.items():
        for item in stretches:
            runs.setdefault((item.run, split), []).append(item)
    found = [_agreement(own, step) for own in runs.values()]
    factors = np.array([np.where(np.diag(c) >= _CLEAR, f, np.nan) for c, f in found])
    low, high = _FACTORS_OF_A_RUN
    for k, (a, b) in enumerate(zip(q.columns, v.columns, strict=True)):
        clear = factors[~np.isnan(factors[:, k]), k]
        if not len(clear):  # the training is warned of as a whole
            continue
        usual = float(np.median(clear))
        for ((run, split), own), factor in zip(runs.items(), factors[:, k], strict=True):
            place = f"{run} ({split}), columns {a!r} and {b!r}"
            if moves(own, k) and not any(item.v[:, k].any() for item in own if item.v is not None):
                report.warn(f"{place}: v is zero throughout this run, while q moves")
            if not np.isnan(factor) and not low <= factor / usual <= high:
                report.warn(
                    f"{place}: the derivative of q is {factor:.4g} times v in this run, and "
                    f"{usual:.4g} times in most: has it other units or signs?"
                )


def moves(training: list[Recording], k: int) -> bool:
    """Whether coordinate k moves by more than noise.

    For noise alone the mean square of the steps is twice the variance (von Neumann 1941).
    """
    every = np.concatenate([item.q[:, k] for item in training])
    steps = np.concatenate([np.diff(item.q[:, k]) for item in training])
    return bool(np.ptp(every) > 0 and (steps**2).mean() <= every.var())


def _agreement(training: list[Recording], step: float) -> tuple[np.ndarray, np.ndarray]:
    """Correlation of Δq_i with ∫ v_k dt, ``(N, N)``, and of each v_i its factor, ``(N,)``."""
    found = [_agreement_over(training, step, samples) for samples in (10, 100, 1000)]
    correlations, factors = (np.array(each) for each in zip(*found, strict=True))
    own = correlations.diagonal(axis1=1, axis2=2)
    return correlations.max(axis=0), factors[own.argmax(axis=0), range(own.shape[1])]


def _agreement_over(
    training: list[Recording], step: float, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """The same over stretches of so many samples."""
    size = training[0].q.shape[1]
    dq, dv = [np.zeros((0, size))], [np.zeros((0, size))]
    for item in training:
        assert item.v is not None
        integral = np.column_stack(
            [np.cumsum(0.5 * step * (v[1:] + v[:-1]))[::samples] for v in item.v.T]
        )
        dq.append(np.diff(item.q[1::samples], axis=0))
        dv.append(np.diff(integral, axis=0))
    moved, integrated = np.vstack(dq), np.vstack(dv)
    squares = (integrated**2).sum(axis=0)
    norms = np.sqrt(np.outer((moved**2).sum(axis=0), squares))
    product = moved.T @ integrated * (len(moved) >= 5)  # fewer are too few to tell
    correlations = np.abs(product) / np.where(norms > 0, norms, np.inf)
    return correlations, np.diag(product) / np.where(squares > 0, squares, np.inf)


def check_force_signs(training: list[Recording], u: Columns, step: float, report: Report) -> None:
    """Warns where a force seems to push backwards; for forces and torques, one per coordinate.

    The acceleration and input i are both freed of what 1, q, q², sin q, cos q, v and the other
    inputs explain (least squares); a correlation of the rests below -0.5 is clear.
    """
    if training[0].q.shape[1] != len(u.columns) or not set(u.units) <= {"Nm", "N"}:
        return
    # So many samples tell, and all of a long log would take gigabytes.
    thin = slice(None, None, max(1, sum(map(len, training)) // _MOST_ROWS))
    q = np.vstack([item.q[thin] for item in training])
    v = np.vstack([item.v[thin] for item in training if item.v is not None])
    # Rates of the inputs may follow the inputs of the log.
    forces = np.vstack([item.u[thin, : len(u.columns)] for item in training])
    acceleration = np.vstack(
        [
            np.column_stack([np.gradient(one, step)[thin] for one in item.v.T])
            for item in training
            if item.v is not None
        ]
    )
    ones = np.ones((len(q), 1))
    for k, name in enumerate(u.columns):
        others = np.delete(forces, k, axis=1)
        known = np.hstack([ones, q, q**2, np.sin(q), np.cos(q), v, others])
        both = np.column_stack([acceleration[:, k], forces[:, k]])
        rest = both - known @ np.linalg.lstsq(known, both, rcond=None)[0]
        norm = np.linalg.norm(rest, axis=0).prod()
        correlation = float(rest[:, 0] @ rest[:, 1]) / norm if norm > 0 else 0.0
        if correlation < _REVERSED:
            report.warn(
                f"input {name!r} seems to push backwards: it correlates with the acceleration of "
                f"coordinate {k + 1} by {correlation:.2f} once position, velocity and other inputs "
                "are accounted for: is its sign reversed?"
            )
