"""Checks of a log as it is read: its clock, held values, single rows, and repeated motions."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection

import numpy as np
import scipy

from pinn_dyn import wording
from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.errors import TRAJECTORY, LogError
from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.data.logs.recording import Recording, burst_steps, clock_steps
from pinn_dyn.data.logs.registers import check_registers
from pinn_dyn.data.logs.stamps import SAMPLE_TIMES, Clock
from pinn_dyn.data.logs.table import Table, alternates

_FEWEST = 20  # updates
_REGULAR = 1.5  # long over short distance of two updates
_TICK = 1.5  # smallest steps, up to which a step is one of an encoder


def held_rows(x: np.ndarray) -> int:
    """Return the rows from one update of columns ``(T, K)`` to the next, 1 if they are not held.

    All columns of a held signal change in the same rows, at regular distances. A slow joint with a
    coarse encoder changes at times, too, but by one step of the encoder.
    """
    steps = np.abs(np.diff(x, axis=0))
    changes = np.flatnonzero(steps.any(axis=1))
    spacing = np.diff(changes)
    if len(spacing) < _FEWEST:
        return 1
    short, usual, long = np.percentile(spacing, [10, 50, 90])
    sizes = steps[changes].max(axis=1)
    ticks = np.mean(sizes <= _TICK * sizes.min())
    if short < 2 or long > _REGULAR * short + 1 or ticks > 0.5:
        return 1
    return int(usual)


_SAME = 0.05  # distance of a repeated motion, as a share of its spread


def check_repeats(
    earlier: list[Recording], pieces: list[Recording], name: str
) -> list[Measurement]:
    """Count the rollouts of the split ``name`` that repeat a motion of the splits before it.

    At a shift s, the mean of ‖q(t) - q_earlier(t + s)‖² is below 0.05² times the variance of q.
    """
    pairs = Counter(
        (piece.run, item.run) for piece in pieces for item in earlier if _is_in(piece, item)
    )
    title = f"motions of the {name} that repeat one of another split"
    results = [
        judged(
            name=title,
            place=run,
            value=count,
            expected="0",
            bad=True,
            text=f"{name}: {count} of the motions of {run} repeat one of {original}, of another "
            "split: keep such runs in one split",
            section="docs/csv_logs.md#splits",
        )
        for (run, original), count in pairs.items()
    ]
    return results or [judged(title, name, 0, "0", False, "")]


def _is_in(piece: Recording, item: Recording) -> bool:
    cut_out = piece.run == item.run and item.t[0] <= piece.t[0] <= item.t[-1]
    if cut_out or len(item) < len(piece):
        return False
    thin = max(1, len(piece) // 300)
    q = piece.q[::thin]
    center = q.mean(axis=0)
    q = q - center
    size = (q**2).sum()
    for start in range(0, thin, max(1, thin // 4)):
        track = item.q[start::thin] - center
        if len(track) >= len(q):
            squares = np.cumsum(np.r_[0.0, (track**2).sum(axis=1)])
            energy = squares[len(q) :] - squares[: -len(q)]
            products = scipy.signal.fftconvolve(track, q[::-1], mode="valid", axes=0).sum(axis=1)
            if (energy - 2 * products + size < _SAME**2 * size).any():
                return True
    return False


_BURST_TEXT = "its stamps come in bursts: take the times from the rows by RowClock"
_GAP_FACTOR = 3.0  # sample times from which a distance between rows is a gap
_BURSTS = 0.4  # share of rows right after the row before from which stamps come in bursts
# A row is a jump if its distance from its neighbors exceeds this multiple of the usual distance.
_JUMP_FACTOR = {"q": 10.0, "v": 10.0, "u": 20.0}
_NEIGHBORS = 7
_FEWEST_TICKS, _TICK_ERROR = 10, 0.1  # steps of a resolution; deviation from multiples of a half
# Numbers that stand for "no value", in the unit of the file.
_NO_VALUE = {-1, *(sign * x for sign in (1, -1) for x in (99, 999, 9999, 99999, 32767, 65535))}
_FAST, _SHORT = 1e-4, 0.1  # s; so fast a clock over so short a run has another unit
_LARGEST = 1e12  # SI units


def _burst_share(t: np.ndarray) -> float:
    """Return the share of rows within a fifth of the mean sample time of the row before.

    It is (n - 1)/n for bursts of n rows, and 0 for rows that are stamped when they are sampled.
    The longest 0.1 % of the distances are gaps and do not count.
    """
    spacing = np.diff(t)
    usual = (
        np.sort(spacing)[: len(spacing) - len(spacing) // 1000 - 1] if len(spacing) > 9 else spacing
    )
    return float((spacing < usual.mean() / 5).mean())


def check_clock(
    t: np.ndarray, table: Table, clock: Clock, repairs: Collection[str]
) -> list[Measurement]:
    """Check the times of one run in s; warn of bursts that no step repairs.

    Raises:
        LogError: on an implausible sample time, and on times that go back, repeat or jump unless a
            step repairs this; names the row and the step.
    """
    if clock.rate is not None:
        return []
    spacing = np.diff(t)

    def rate(value: float) -> str:
        text = wording.entry("time", {"rate": float(f"{value:.4g}")})
        return f"state the rate in Hz instead, as in {text}"

    if not (spacing > 0).any():
        raise LogError(
            f"{table.place(0, clock.name)}: the time never increases in this run: " + rate(100)
        )
    typical = float(spacing.mean() if "bursts" in repairs else np.median(spacing[spacing > 0]))
    low, high = SAMPLE_TIMES
    usual = low <= typical <= high and not (typical < _FAST and np.ptp(t) < _SHORT)
    if not usual and (spacing >= 0).all():
        shared = int(np.median(np.unique(t, return_counts=True)[1]))  # stamps in whole seconds
        unit = clock.plausible_unit(table, typical) if shared == 1 else ""
        cure = f"write the unit {unit}, or " if unit else ""
        raise LogError(
            f"{table.name}, column {clock.name!r}: the sample time would be {typical:.6g} s in a "
            f"run of {np.ptp(t):.4g} s, expected {low:g} to {high:g} s: "
            f"{cure}{rate(shared / typical)}"
        )
    same = spacing == 0
    if same.any():  # a logger that is faster than its source repeats whole rows
        same[same] = table.frame.duplicated().to_numpy()[1:][same]
    bursts = _burst_share(t[np.r_[True, ~same]])
    steps = f"as in{clock_steps(t)}"
    split = f"name the column that tells runs apart in {TRAJECTORY}"
    once = f"add a Deduplicate step, which keeps the first row, {steps}"
    fill = f"split long gaps and interpolate over short ones, {steps}"
    in_bursts = bursts > _BURSTS
    if in_bursts:
        once = fill = f"{_BURST_TEXT}, as in\n\n{wording.steps(burst_steps(t))}"
    for fault, rows, problem, cure in (
        ("backward times", spacing < 0, "goes back", split),
        ("repeated times", spacing == 0, "repeats", once),
        ("gaps", spacing > _GAP_FACTOR * typical, "jumps", fill),
    ):
        if rows.any() and fault not in repairs:
            k = int(rows.argmax())
            raise LogError(
                f"{table.place(k + 1, clock.name)}: the time {problem} from {t[k]:.9g} to "
                f"{t[k + 1]:.9g} s ({int(rows.sum())} such rows, {typical:.6g} s is usual): "
                f"{cure}"
            )
    measurement = judged(
        name="share of rows in bursts",
        place=table.name,
        value=bursts,
        expected=f"below {_BURSTS}",
        bad=in_bursts and "bursts" not in repairs,
        text=f"{table.name}: {_BURST_TEXT}, first of the steps: {' '.join(burst_steps(t))}",
    )
    return [measurement]


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
    median of seven than ten (u: twenty) times the 99th percentile of all these medians.

    Raises:
        LogError: on numbers that stand for "no value", unsigned registers, an angle that wraps, two
            runs row by row.
    """
    if (large := np.abs(values) > _LARGEST).any():
        row, k = np.argwhere(large)[0]
        raise LogError(
            f"{table.place(row, columns.columns[k], signal)}: the value {values[row, k]:.4g} is no "
            f"measurement, it stands for 'no value' ({int(large.sum())} such values)"
        )
    if len(t) < 2 * _NEIGHBORS:
        return []
    check_registers(table, signal, columns, values)
    spacing = np.diff(t)
    in_step = (spacing > 0) & (spacing < 3 * np.median(spacing))
    warnings = []
    for name, x, unit in zip(columns.columns, values.T, columns.units, strict=True):
        if signal == "q":
            _check_angle(table, name, x, unit, in_step)
        if f"jumps of {signal}" not in repairs:
            warnings.append(_jumps(table, signal, name, x, unit, in_step))
    return [Measurement("jumps and spikes", text=x, verdict="warning") for x in warnings if x]


def _check_angle(table: Table, name: str, q: np.ndarray, unit: str, in_step: np.ndarray) -> None:
    steps = np.diff(q)
    slow = (
        np.abs(scipy.ndimage.median_filter(steps, 3)) < math.pi
    )  # a fast motor turns so far in each row
    wraps = np.flatnonzero(in_step & slow & (np.abs(np.abs(steps) - 2 * math.pi) < 0.3))
    if unit == "rad" and len(wraps):
        row = int(wraps[0])
        raise LogError(
            f"{table.place(row + 1, name, 'q')}: the angle wraps from {q[row]:.5g} to "
            f"{q[row + 1]:.5g} rad ({len(wraps)} times): unwrap the column (numpy.unwrap) before"
        )
    if alternates(q):
        raise LogError(
            f"{table.place(1, name, 'q')}: rows go to and fro by {abs(q[1] - q[0]):.4g} {unit}: "
            f"two runs share the clock; name the column that tells them apart in {TRAJECTORY}"
        )


def _jumps(
    table: Table, signal: str, name: str, x: np.ndarray, unit: str, in_step: np.ndarray
) -> str:
    steps = signal == "q"
    value = np.where(in_step, np.diff(x), 0.0) if steps else x - np.median(x)
    smooth = scipy.ndimage.median_filter(value, _NEIGHBORS, mode="nearest")
    usual = np.abs(smooth[smooth != 0])
    if len(usual) < 100:  # a signal that is still, or moves in a few steps
        return ""
    distance = np.abs(value - smooth)
    bad = distance > _JUMP_FACTOR[signal] * np.percentile(usual, 99)
    if not bad.any():
        return ""
    first = int((bad & (distance > 0.5 * distance.max())).argmax())  # a spike goes and comes back
    row = first + 1 if steps else first
    if _are_ticks(distance[bad]) and table.frame[name].iloc[row] not in _NO_VALUE:
        return ""
    threshold = float(f"{distance[first] / 2:.2g}")
    repair = wording.step("RemoveJumps", threshold=threshold, window=5, signals=[signal])
    return (
        f"{table.place(row, name, signal)}: a {'jump' if steps else 'spike'} to {x[row]:.5g} "
        f"{unit}, {distance[first]:.3g} from the value that its neighbors make likely "
        f"({int(bad.sum())} such rows in this run): does it stand for 'no value'? Add the step "
        f"{repair}, or name a new run that begins there in {TRAJECTORY}"
    )


def _are_ticks(sizes: np.ndarray) -> bool:
    """Tell whether sizes are multiples of a resolution, as of encoders or velocities of ticks."""
    halves = 2 * sizes / np.median(sizes)
    even = np.abs(halves - halves.round()) < _TICK_ERROR
    return len(sizes) >= _FEWEST_TICKS and bool(even.mean() > 0.9 and halves.max() < 20)
