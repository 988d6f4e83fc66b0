"""Steps that repair the clock of a log, or shift its inputs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.recording import SIGNALS, Recording
from pinn_dyn.data.logs.step import Step

_ROUNDING = 1e-3  # rounding of times, in sample times


@dataclass(frozen=True)
class Deduplicate(Step):
    """Drop rows that repeat the time, or all values, of the previous row.

    Args:
        longest: longest series of repeated values that is dropped. In a longer series, the robot is
            at rest.
    """

    longest: PositiveInt = 5
    repairs = ("repeated times",)

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        values = recording.values()
        same_time = np.r_[False, np.diff(recording.t) == 0]
        stale = np.r_[False, (values[1:] == values[:-1]).all(axis=1)]
        for first, end in np.flatnonzero(np.diff(np.r_[False, stale, False])).reshape(-1, 2):
            if end - first > self.longest:
                stale[first:end] = False
        drop = same_time | stale
        text = (
            f"dropped {drop.sum()} of {len(drop)} rows ({100 * drop.mean():.2g} %), "
            f"{same_time.sum()} with the time of the row before"
        )
        return [recording.rows(~drop)], text


@dataclass(frozen=True)
class SplitGaps(Step):
    """Split a run where the time jumps by more than ``longest``, or backwards.

    Args:
        longest: longest time between two rows without a split, s.
    """

    longest: PositiveFloat
    repairs = ("gaps",)

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        spacing = np.diff(recording.t)
        gaps = np.flatnonzero((spacing > self.longest) | (spacing < 0)) + 1
        edges = [0, *gaps.tolist(), len(recording)]
        parts = [recording.rows(slice(a, b)) for a, b in itertools.pairwise(edges)]
        times = listed(f"{recording.t[k - 1]:.6g} s" for k in gaps)
        text = f"{len(gaps)} gaps" + (f", after {times}" if times else "")
        return [part for part in parts if len(part) > 1], text


@dataclass(frozen=True)
class Resample(Step):
    """Interpolate linearly to a uniform clock t_k = t_0 + k / rate.

    Args:
        rate: samples per second, Hz.
        max_gap: longest time between two rows for an interpolation, s.
    """

    rate: PositiveFloat
    max_gap: PositiveFloat
    repairs = ("gaps",)

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        t = recording.t
        spacing = np.diff(t)
        if not (spacing > 0).all():
            raise LogError(
                f"{recording.place}: Resample needs times that increase: put Deduplicate before it"
            )
        widest = int(spacing.argmax())
        if spacing[widest] > self.max_gap:
            raise LogError(
                f"{recording.place}: Resample found a gap of {spacing[widest]:.4g} s after t = "
                f"{t[widest]:.6g} s: put SplitGaps before it, or raise max_gap, {self.max_gap} s"
            )
        # Rounding may put the last sample just beyond the end.
        count = int(np.floor((t[-1] - t[0]) * self.rate + 1e-6)) + 1
        clock = t[0] + np.arange(count) / self.rate

        def at(values: np.ndarray) -> np.ndarray:
            return np.column_stack([np.interp(clock, t, column) for column in values.T])

        text = (
            f"{len(t)} rows, {1e3 * spacing.min():.3g} to {1e3 * spacing.max():.3g} ms apart, to "
            f"{count} samples at {self.rate:g} Hz"
        )
        return [replace(recording.change(SIGNALS, at), t=clock)], text


@dataclass(frozen=True)
class InputDelay(Step):
    """Shift each input to the time at which it acts: u_i(t) becomes u_i(t - d_i).

    Between two samples, u is interpolated linearly. For an input that is held between its samples,
    the result is the mean of u(t - d) over each sample. The first max(d) s are dropped.

    Args:
        delay: d, s, one number, or one per input. Rates that :class:`InputRates` has appended have
            the delays of their inputs.
    """

    delay: NonNegativeFloat | Sequence[NonNegativeFloat]

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        delays, t, inputs = np.atleast_1d(self.delay), recording.t, recording.u.shape[1]
        if inputs % len(delays):
            raise LogError(f"delay has {len(delays)} entries, expected 1 or {inputs}")
        pairs = zip(np.resize(delays, inputs), recording.u.T, strict=True)
        u = [np.interp(t - d, t, x) for d, x in pairs]
        start = t[0] + delays.max() - _ROUNDING * np.median(np.diff(t))
        has_input = t >= start
        if has_input.sum() < 2:
            raise LogError(
                f"{recording.place}: the run is shorter than the input delay: drop the run"
            )
        shifted = replace(recording, u=np.column_stack(u)).rows(has_input)
        return [shifted], f"u delayed by {listed(f'{d:.4g} s' for d in dict.fromkeys(delays))}"
