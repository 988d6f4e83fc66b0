"""Checks of a log as it is read: its clock, and single rows that no robot can have.

Errors name a row and a step that repairs the log. Warnings are measurements.
"""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np
from scipy.ndimage import median_filter

from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.measurement import Measurement
from pinn_dyn.data.logs.table import Table

# Logs of robots are written between 2 Hz and 100 kHz.
_SAMPLE_TIMES = (1e-5, 0.5)
# A row may be this much late, as a multiple of the usual sample time, before it counts as a gap.
_GAP_FACTOR = 3.0
# Share of rows right after the row before from which stamps come in bursts.
BURSTS = 0.4
# A row is a jump if its distance from its neighbors exceeds this multiple of the usual distance.
_JUMP_FACTOR = {"q": 10.0, "v": 10.0, "u": 20.0}
_NEIGHBORS = 7
_LARGEST = 1e12  # SI units
# A value that stands for "no value": number of its rows, and its distance in usual steps.
_PLACEHOLDER_ROWS, _PLACEHOLDER_DISTANCE = 4, 20.0


def burst_share(t: np.ndarray) -> float:
    """Return the share of rows within a fifth of the mean sample time of the row before.

    Rows that are stamped when they are sampled keep their distance; a burst of n rows has
    (n - 1)/n of such rows.
    """
    return float((np.diff(t) < (t[-1] - t[0]) / (len(t) - 1) / 5).mean())


def check_clock(t: np.ndarray, table: Table, column: str, repairs: Collection[str]) -> None:
    """Check the times of one run.

    Args:
        t: the times, s.
        table: rows of the run.
        column: column of the time.
        repairs: faults that a cleaning step repairs, see :attr:`Step.repairs`.

    Raises:
        LogError: on an implausible sample time, and on times that go back, repeat or jump unless a
            step repairs this; names the row and the step.
    """
    if len(t) < 2:
        raise LogError(f"{table.place(0)}: a run of one row, expected at least two")
    spacing = np.diff(t)
    bursts = burst_share(t) > BURSTS

    def refuse(rows: np.ndarray, problem: str, cure: str) -> None:
        k = int(rows.argmax())
        step = f", where {typical:.6g} s is usual" if problem == "jumps" else ""
        if bursts and problem != "goes back":
            cure = (
                "its stamps come in bursts of rows: take the time from the row number, by the step "
                f"examples.cleaning_steps.RowClock, or {cure}"
            )
        raise LogError(
            f"{table.place(k + 1, column)}: the time {problem} from {t[k]:.9g} to {t[k + 1]:.9g} s"
            f"{step} ({int(rows.sum())} such rows): {cure}"
        )

    forward = spacing[spacing > 0]
    if not len(forward):
        raise LogError(f"{table.name}, column {column!r}: the time never increases")
    typical = float(spacing.mean() if "bursts" in repairs else np.median(forward))
    if (back := spacing < 0).any() and "backward times" not in repairs:
        refuse(
            back,
            "goes back",
            "if a new run starts there, name its column in 'trajectory' (run=... of "
            "pinn_dyn.fit) or add a SplitGaps step; otherwise repair the log",
        )
    if (repeated := spacing == 0).any() and "repeated times" not in repairs:
        refuse(repeated, "repeats", "add a Deduplicate step, which keeps the first row")
    low, high = _SAMPLE_TIMES
    if not low <= typical <= high:
        raise LogError(
            f"{table.name}, column {column!r}: the sample time would be {typical:.6g} s, expected "
            f"{low:g} to {high:g} s: is the unit of the time wrong "
            f"({'ms' if typical > high else 's'}?)"
        )
    if (gaps := spacing > _GAP_FACTOR * typical).any() and "gaps" not in repairs:
        refuse(gaps, "jumps", "add a SplitGaps step, or Resample to interpolate over short gaps")


def check_second_clock(
    t: np.ndarray, second: np.ndarray, table: Table, columns: tuple[str, str]
) -> None:
    """Raise a LogError if two clocks of one run, in s, drift apart by a sample time."""
    typical = float(np.median(np.abs(np.diff(t))))
    difference = np.abs((t - t[0]) - (second - second[0]))
    if (difference > typical).any():
        k = int((difference > typical).argmax())
        raise LogError(
            f"{table.place(k)}: the clocks {columns[0]!r} and {columns[1]!r} disagree by "
            f"{difference[k]:.4g} s: check their units, and keep the clock of the robot alone"
        )


def check_rows(
    table: Table,
    t: np.ndarray,
    signal: str,
    columns: Columns,
    values: np.ndarray,
    repairs: Collection[str],
) -> list[Measurement]:
    """Check the values of one signal of one run, ``(T, K)`` in SI units.

    Warns of jumps and spikes: rows whose step (of q) or value (of v and u) is further from the
    median of seven than ten (u: twenty) times the 99th percentile of all steps or values.

    Raises:
        LogError: on numbers that stand for "no value", an angle that wraps, two runs row by row.
    """
    if (large := np.abs(values) > _LARGEST).any():
        row, k = np.argwhere(large)[0]
        raise LogError(
            f"{table.place(row, columns.columns[k], signal)}: the value {values[row, k]:.4g} is no "
            f"measurement, it stands for 'no value' ({int(large.sum())} such values): remove them"
        )
    if len(t) < 2 * _NEIGHBORS:
        return []
    spacing = np.diff(t)
    in_step = (spacing > 0) & (spacing < 3 * np.median(spacing))
    warnings = []
    for k, name in enumerate(columns.columns):
        x, unit = values[:, k], columns.units[k]
        if signal == "q":
            _check_wrap(table, name, x, unit, in_step)
            _check_mixture(table, name, x, unit)
        if f"jumps of {signal}" not in repairs:
            warnings += [
                _placeholders(table, signal, name, x, unit),
                _jumps(table, signal, name, x, unit, in_step),
            ]
    return [Measurement("jumps and spikes", text=x, verdict="warning") for x in warnings if x]


def _check_wrap(table: Table, name: str, q: np.ndarray, unit: str, in_step: np.ndarray) -> None:
    wraps = np.flatnonzero(in_step & (np.abs(np.abs(np.diff(q)) - 2 * math.pi) < 0.3))
    if unit == "rad" and len(wraps):
        row = int(wraps[0])
        raise LogError(
            f"{table.place(row + 1, name, 'q')}: the angle wraps from {q[row]:.5g} to "
            f"{q[row + 1]:.5g} rad ({len(wraps)} times): unwrap the column (numpy.unwrap) before"
        )


def _check_mixture(table: Table, name: str, q: np.ndarray, unit: str) -> None:
    """Refuse rows that alternate between two motions: steps of one row are large, of two small."""
    one_row, two_rows = (float(np.median(np.abs(q[n:] - q[:-n]))) for n in (1, 2))
    if one_row > 0.02 * np.ptp(q) and two_rows < 0.2 * one_row:
        raise LogError(
            f"{table.place(1, name, 'q')}: rows go to and fro by {one_row:.4g} {unit}: two runs "
            "share the clock; name the column that tells them apart in 'trajectory'"
        )


def _placeholders(table: Table, signal: str, name: str, x: np.ndarray, unit: str) -> str:
    """Return a warning of a value in single rows, too many for an unusual step; "" without."""
    steps = np.abs(np.diff(x))
    sample = steps[:: 1 + len(x) // 50_000]
    if signal == "u" or not sample.any():
        return ""
    far = _PLACEHOLDER_DISTANCE * np.median(sample[sample > 0])
    if not (steps > far).any():
        return ""
    spikes = np.flatnonzero(np.abs(x - median_filter(x, _NEIGHBORS, mode="nearest")) > far)
    levels, first, counts = np.unique(x[spikes], return_index=True, return_counts=True)
    if not len(levels) or counts.max() < _PLACEHOLDER_ROWS:
        return ""
    k = int(counts.argmax())
    return (
        f"{table.place(int(spikes[first[k]]), name, signal)}: the value {levels[k]:.5g} {unit} "
        f"comes in {counts[k]} rows, each far from its neighbors: does it stand for 'no value'? "
        "Remove these rows, or add a RemoveJumps step"
    )


def _jumps(
    table: Table, signal: str, name: str, x: np.ndarray, unit: str, in_step: np.ndarray
) -> str:
    """Return a warning of jumps of q, or spikes of v and u; "" without."""
    steps = signal == "q"
    value = np.where(in_step, np.diff(x), 0.0) if steps else x - np.median(x)
    usual = np.abs(value[value != 0])
    if len(usual) < 100:  # a signal that is still, or moves in a few steps
        return ""
    distance = np.abs(value - median_filter(value, _NEIGHBORS, mode="nearest"))
    bad = np.flatnonzero(distance > _JUMP_FACTOR[signal] * np.percentile(usual, 99))
    if not len(bad):
        return ""
    first = int(bad[distance[bad] > 0.5 * distance.max()][0])  # a spike goes and comes back
    row = first + 1 if steps else first
    cure = ": add a RemoveJumps step, or name a new run that begins there in 'trajectory'"
    return (
        f"{table.place(row, name, signal)}: a {'jump' if steps else 'spike'} to {x[row]:.5g} "
        f"{unit}, {distance[first]:.3g} from the value that its neighbors make likely "
        f"({len(bad)} such rows in this run){cure if steps else ': is it a fault of the log?'}"
    )
