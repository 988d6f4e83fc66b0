"""Detect unsigned registers with negative numbers, and rows before the first measurement."""

from __future__ import annotations

import numpy as np

from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.table import Table

_BITS = (16, 32)
_CONTINUOUS = 0.1  # largest ratio of the largest steps of signed and unsigned numbers
_FIRST_STEP = 10.0  # smallest ratio of the first step to the largest later step
_FEW = 0.1  # largest share of rows before the first measurement


def check_registers(table: Table, signal: str, columns: Columns, values: np.ndarray) -> None:
    """Raise an error for negative numbers that were logged from a register as unsigned numbers.

    All numbers ``(T, K)`` are multiples of a step, in the unit of the file. Some lie in the lower
    half of 2^16 or 2^32 steps, and some in the upper half. If this period is subtracted from the
    numbers in the upper half, the signal is continuous.

    Raises:
        LogError: if such numbers exist. The message names the first row and the period.
    """
    for name, raw in zip(columns.columns, columns.from_si(values).T, strict=True):
        if raw.min() < 0 or not np.ptp(raw):
            continue
        spacing = np.diff(np.unique(raw))
        step = spacing[spacing > 1e-12 * raw.max()].min()
        counts = (raw / step).round()
        for bits in _BITS:
            upper = counts >= 2 ** (bits - 1)
            signed = np.where(upper, counts - 2**bits, counts)
            smooth = np.abs(np.diff(signed)).max() < _CONTINUOUS * np.abs(np.diff(counts)).max()
            integers = np.abs(raw / step - counts).max() < 0.1 and counts.max() < 2**bits
            if integers and smooth and upper.any():
                row, period = int(upper.argmax()), 2**bits * step
                raise LogError(
                    f"{table.place(row, name, signal)}: {raw[row]:.6g} is a negative number of an "
                    f"unsigned register of {bits} bits ({int(upper.sum())} such rows): first "
                    f"subtract {period:.6g} from all values above {period / 2:.6g}"
                )


def rows_before_first_sample(q: np.ndarray) -> int:
    """Return the number of equal first rows of q ``(T, N)`` before a jump to the first measurement.

    The jump is more than ten times as large as all later steps of its column. A logger may write
    zeros before the first message of a robot.
    """
    steps = np.abs(np.diff(q, axis=0))
    moving = steps.any(axis=1)
    if not moving.any():
        return 0
    first = int(moving.argmax())
    later = steps[first + 1 :].max(axis=0, initial=0.0)
    jumps = (steps[first] > _FIRST_STEP * later)[later > 0].any()
    return first + 1 if jumps and first + 1 < _FEW * len(q) else 0
