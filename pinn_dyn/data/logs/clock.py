"""Steps that mend the clock of a log."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.logs.step import Step

# A row may be this much late, as a multiple of the median sample time, before it counts as a gap.
GAP_FACTOR = 3.0
# Share of rows like the one before from which a log has them twice.
_WRITTEN_TWICE = 0.2


@dataclass(frozen=True)
class Deduplicate(Step):
    """Drops rows with the time of the row before, and rows that repeat all its values.

    Some loggers write faster than the robot answers: the row is then stale, though its time is new.
    More than ``longest`` repeats in a row are a robot at rest, and kept.

    Args:
        longest: the most repeats in a row that are taken for stale rows.
    """

    longest: int = 5

    def __post_init__(self) -> None:
        if self.longest < 1:
            raise LogError(f"Deduplicate: longest is {self.longest}, expected at least 1")

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        values = recording.values()
        same_time = np.r_[False, np.diff(recording.t) == 0]
        stale = np.r_[False, (values[1:] == values[:-1]).all(axis=1)]
        edges = np.flatnonzero(np.diff(np.r_[False, stale, False]))
        for first, end in edges.reshape(-1, 2):
            if end - first > self.longest:
                stale[first:end] = False
        drop = same_time | stale
        share = 100 * drop.mean()
        text = (
            f"dropped {drop.sum()} of {len(drop)} rows ({share:.2g} %): {same_time.sum()} with the "
            f"time of the row before, {(stale & ~same_time).sum()} with its values"
        )
        return [recording.rows(~drop)], text


@dataclass(frozen=True)
class SplitGaps(Step):
    """Splits a run where the time jumps by more than ``longest``, or backwards.

    Args:
        longest: longest step of the time that is no gap, s.
    """

    longest: float

    def __post_init__(self) -> None:
        if not self.longest > 0:
            raise LogError(f"SplitGaps: longest is {self.longest} s, expected more than 0")

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        spacing = np.diff(recording.t)
        gaps = np.flatnonzero((spacing > self.longest) | (spacing < 0)) + 1
        edges = [0, *gaps.tolist(), len(recording)]
        parts = [recording.rows(slice(a, b)) for a, b in itertools.pairwise(edges)]
        whole = [part for part in parts if len(part) > 1]
        where = ", ".join(f"{recording.t[k - 1]:.6g} s" for k in gaps[:5])
        more = " ..." if len(gaps) > 5 else ""
        text = f"{len(gaps)} gaps" + (f", after {where}{more}" if len(gaps) else "")
        if len(whole) < len(parts):
            text += f"; dropped {len(parts) - len(whole)} stretches of a single row"
        return whole, text


@dataclass(frozen=True)
class Resample(Step):
    """A uniform clock t_k = t_0 + k / rate, the signals linear between the rows of the log.

    Args:
        rate: samples per second, Hz.
        max_gap: longest time between two rows that is interpolated, s.
    """

    rate: float
    max_gap: float

    def __post_init__(self) -> None:
        if not (self.rate > 0 and self.max_gap > 0):
            raise LogError(
                f"Resample: rate is {self.rate} Hz and max_gap {self.max_gap} s, expected more "
                "than 0"
            )

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        t = recording.t
        if len(t) < 2 or not (np.diff(t) > 0).all():
            raise LogError(
                f"{recording.place}: Resample needs at least two rows, in times that increase: put "
                "Deduplicate or SplitGaps before it"
            )
        spacing = np.diff(t)
        widest = int(spacing.argmax())
        if spacing[widest] > self.max_gap:
            raise LogError(
                f"{recording.place}: Resample found a gap of {spacing[widest]:.4g} s after t = "
                f"{t[widest]:.6g} s, longer than max_gap, {self.max_gap} s: put SplitGaps before "
                "it, or raise max_gap"
            )
        # The last sample may round to just beyond the end.
        count = int(np.floor((t[-1] - t[0]) * self.rate + 1e-6)) + 1
        clock = t[0] + np.arange(count) / self.rate

        def at(values: np.ndarray) -> np.ndarray:
            return np.column_stack([np.interp(clock, t, column) for column in values.T])

        v = None if recording.v is None else at(recording.v)
        resampled = Recording(recording.run, clock, at(recording.q), v, at(recording.u))
        text = (
            f"{len(t)} rows, {1e3 * spacing.min():.3g} to {1e3 * spacing.max():.3g} ms apart, to "
            f"{count} samples at {self.rate:g} Hz"
        )
        return [resampled], text


@dataclass(frozen=True)
class RowClock(Step):
    """Times from the numbers of the rows, where the stamps come in bursts::

        t_k = a + k / rate

    A logger that empties a buffer stamps its rows when it writes them, not when they were sampled:
    many rows share one stamp, or follow within microseconds, and then nothing comes for a while. a
    is that of the line through the stamps, by least squares, and the rate where it is not given.
    Right only where no row is missing.

    Args:
        longest: longest time between a stamp and the line, s: some bursts. More means lost rows.
        rate: samples per second, Hz; None: from the stamps of the training runs.
    """

    longest: float
    rate: float | None = None

    def __post_init__(self) -> None:
        if not self.longest > 0 or not (self.rate is None or self.rate > 0):
            raise LogError(
                f"RowClock: longest is {self.longest} s and rate {self.rate} Hz, expected more "
                "than 0"
            )

    @property
    def learns(self) -> bool:
        return self.rate is None

    def fit(self, training: list[Recording]) -> Step:
        if self.rate is not None:
            return self
        rows = [np.arange(len(item)) - (len(item) - 1) / 2 for item in training]
        squares = sum(float(k @ k) for k in rows)
        slope = sum(float(k @ item.t) for k, item in zip(rows, training, strict=True)) / squares
        if not slope > 0:
            raise LogError("RowClock: the time does not increase along the training runs")
        return replace(self, rate=1 / slope)

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        assert self.rate is not None
        rows, t, step = np.arange(len(recording)), recording.t - recording.t[0], 1 / self.rate
        line = step * rows + (t - step * rows).mean()
        off = np.abs(t - line)
        k = int(off.argmax())
        if off[k] > self.longest:
            raise LogError(
                f"{recording.place}: RowClock found the stamp {recording.t[k]:.6g} s {off[k]:.4g} s"
                f" off a clock of {step:.6g} s, more than longest, {self.longest} s: rows are "
                "missing, or the rate changes: put SplitGaps before it, or raise longest to the "
                "length of some bursts"
            )
        signals = [x for x in (recording.q, recording.v, recording.u) if x is not None]
        again = np.all([(np.diff(x, axis=0) == 0).all(axis=1) for x in signals], axis=0)
        twice = again & (np.diff(recording.t) == 0)
        if twice.mean() > _WRITTEN_TWICE:
            raise LogError(
                f"{recording.place}: RowClock found {int(twice.sum())} rows with the stamp and all "
                "the values of the row before: they were written twice; put Deduplicate before it"
            )
        text = f"t from the row number, {step:.6g} s a row; stamps were up to {off[k]:.4g} s off"
        return [replace(recording, t=recording.t[0] + line)], text


def burst_share(t: np.ndarray) -> float:
    """Share of rows that are stamped within a fifth of the mean sample time after the one before.

    Rows that are sampled when they are stamped keep their distance, a burst of n rows has
    (n - 1)/n of them.
    """
    return float((np.diff(t) < (t[-1] - t[0]) / (len(t) - 1) / 5).mean())
