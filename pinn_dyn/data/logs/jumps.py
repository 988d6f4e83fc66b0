"""Single rows of a log that no robot can have: wrapped angles, jumps, spikes, mixed runs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Report
from pinn_dyn.data.logs.table import Table

# SI; no signal of a robot is larger, numbers for "no value" are.
_LARGEST = 1e12
# A row further from its neighbours than so many times what is usual is no motion.
_FACTOR = {"q": 10.0, "v": 10.0, "u": 20.0}
_NEIGHBOURS = 7
# So often one value far from its neighbours stands for none; how far, in usual steps.
_OFTEN, _FAR = 4, 20.0


@dataclass(frozen=True)
class Rows:
    """One signal of one run as it was read, in SI units, and where it comes from.

    Attributes:
        table: rows of the run.
        signal: q, v or u.
        columns: names and units of the columns.
        values: ``(T, K)``.
    """

    table: Table
    signal: str
    columns: Columns
    values: np.ndarray

    def place(self, row: int, column: int) -> str:
        """File, line and column, for messages."""
        return self.table.place(row, self.columns.columns[column], self.signal)


def check_rows(rows: Rows, t: np.ndarray, report: Report, *, jumps_are_removed: bool) -> None:
    """One signal of one run at its times, ``(T,)``.

    Warns of jumps and spikes: rows whose step (of q) or value (of v and u) is further from the
    median of seven than ten (u: twenty) times the 99th percentile of all steps or values.

    Raises:
        LogError: on values above 1e12, an angle that wraps, and two runs row by row; names the
            file, the line and the column.
    """
    large = np.argwhere((rows.values > _LARGEST) | (rows.values < -_LARGEST))
    if len(large):
        row, column = large[0]
        raise LogError(
            f"{rows.place(row, column)}: the value is {rows.values[row, column]:.4g} in SI units, "
            f"expected at most {_LARGEST:g}: such a number stands for 'no value' ({len(large)} of "
            "them in this signal); remove these rows"
        )
    if len(t) < 2 * _NEIGHBOURS:
        return
    spacing = np.diff(t)
    in_step = (spacing > 0) & (spacing < 3 * np.median(spacing))
    for k in range(rows.values.shape[1]):
        if rows.signal == "q":
            if rows.columns.units[k] == "rad":
                _check_wrap(rows, k, in_step)
            _check_mixture(rows, k)
        if not jumps_are_removed:
            _check_dropouts(rows, k, report)
            _check_jumps(rows, k, in_step, report)


def _check_wrap(rows: Rows, k: int, in_step: np.ndarray) -> None:
    q = rows.values[:, k]
    turns = np.flatnonzero(in_step & (np.abs(np.abs(np.diff(q)) - 2 * math.pi) < 0.3))
    if len(turns):
        row = int(turns[0])
        raise LogError(
            f"{rows.place(row + 1, k)}: the angle wraps from {q[row]:.5g} to {q[row + 1]:.5g} rad "
            f"({len(turns)} times in this run), expected an angle that goes on beyond a turn: "
            "unwrap the column (numpy.unwrap) before"
        )


def _check_mixture(rows: Rows, k: int) -> None:
    """Every second row belongs to another motion: steps go to and fro, and two make none."""
    q = rows.values[:, k]
    one, two = (float(np.median(np.abs(q[n:] - q[:-n]))) for n in (1, 2))
    if one > 0.02 * np.ptp(q) and two < 0.2 * one:
        raise LogError(
            f"{rows.place(1, k)}: rows go to and fro by {one:.4g} {rows.columns.units[k]}, and "
            f"every second row by {two:.4g}: two runs share the clock; name the column that tells "
            "them apart in 'trajectory', or write each to a file of its own"
        )


def _check_dropouts(rows: Rows, k: int, report: Report) -> None:
    """One value in single rows, far from their neighbours: so many that no step is unusual."""
    x = rows.values[:, k]
    if rows.signal == "u":
        return
    every = np.abs(np.diff(x))
    steps = every[:: 1 + len(x) // 50_000]  # of a long log so many tell what is usual
    if not steps.any() or not (every > (far := _FAR * np.median(steps[steps > 0]))).any():
        return
    off = np.abs(x - median_filter(x, _NEIGHBOURS, mode="nearest"))
    spikes = np.flatnonzero(off > far)
    found, first, counts = np.unique(x[spikes], return_index=True, return_counts=True)
    if len(found) and counts.max() >= _OFTEN:
        most = int(counts.argmax())
        report.warn(
            f"{rows.place(int(spikes[first[most]]), k)}: the value {found[most]:.5g} "
            f"{rows.columns.units[k]} comes in {counts[most]} rows, each far from its neighbours: "
            "does it stand for 'no value'? Remove these rows, or add a RemoveJumps step"
        )


def _check_jumps(rows: Rows, k: int, in_step: np.ndarray, report: Report) -> None:
    x = rows.values[:, k]
    steps = rows.signal == "q"
    value = np.where(in_step, np.diff(x), 0.0) if steps else x - np.median(x)
    usual = np.abs(value[value != 0])
    if len(usual) < 100:  # a signal that is still, or moves in a few steps
        return
    off = np.abs(value - median_filter(value, _NEIGHBOURS, mode="nearest"))
    bad = np.flatnonzero(off > _FACTOR[rows.signal] * np.percentile(usual, 99))
    if len(bad):
        first = int(bad[off[bad] > 0.5 * off.max()][0])  # a spike goes and comes back
        row = first + 1 if steps else first
        cure = ": add a RemoveJumps step, or name a new run that begins there in 'trajectory'"
        report.warn(
            f"{rows.place(row, k)}: a {'jump' if steps else 'spike'} to {x[row]:.5g} "
            f"{rows.columns.units[k]}, {off[first]:.3g} from what its neighbours make likely "
            f"({len(bad)} such rows in this run){cure if steps else ': is it a fault of the log?'}"
        )
