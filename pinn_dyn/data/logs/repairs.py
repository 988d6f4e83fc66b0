"""Steps that repair what sensors and drives do to the signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from pinn_dyn.data.lengths import Length
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.logs.step import (
    Step,
    change,
    check_signals,
    check_window,
    window_samples,
)

# Share of the rows that may be jumps; more are noise or motion.
_MANY = 0.05


@dataclass(frozen=True)
class RemoveJumps(Step):
    """Replaces samples far from the median of their neighbours, such as jumps of a marker.

    A sample is bad where |x_k - median(x_{k-h}, ..., x_{k+h})| > threshold, h = (window - 1)/2. It
    takes the value of the straight line between the good samples around it, and the report says
    when and how far it was off. A jump that lasts longer than h samples is not found, and the first
    and last h samples are not judged, as a one-sided median lags behind a motion.

    Args:
        threshold: largest distance from the median that is no jump, SI units; one value, or one
            per column.
        window: number of samples, odd, or a time, such as ``"0.25 s"``.
        signals: which of q, v and u.
    """

    threshold: float | Sequence[float]
    window: Length = 25
    signals: Sequence[str] = ("q",)

    def __post_init__(self) -> None:
        check_signals(self.signals)
        check_window("RemoveJumps", self.window, 3, odd=True)
        if not np.all(np.asarray(self.threshold) > 0):
            raise LogError(f"RemoveJumps: threshold is {self.threshold}, expected more than 0")

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        found: list[str] = []
        window = window_samples(self.window, recording, 3, odd=True)

        def repair(x: np.ndarray) -> np.ndarray:
            if np.ndim(self.threshold) and len(np.atleast_1d(self.threshold)) != x.shape[1]:
                raise LogError(
                    f"RemoveJumps: threshold has {np.size(self.threshold)} entries, expected one, "
                    f"or one for each of {x.shape[1]} columns"
                )
            frame = pd.DataFrame(x)
            median = frame.rolling(window, center=True).median()
            off = (frame - median).abs()
            bad = off > np.asarray(self.threshold)
            rows = np.flatnonzero(bad.any(axis=1))
            found.extend(f"{recording.t[k]:.6g} s ({off.iloc[k].max():.2g})" for k in rows)
            good = frame.mask(bad)
            if good.isna().all().any():
                raise LogError(f"{recording.place}: RemoveJumps found no good sample in a column")
            return good.interpolate(limit_direction="both").to_numpy()

        repaired = change(recording, self.signals, repair)
        if not found:
            return [repaired], "no jumps"
        more = " ..." if len(found) > 20 else ""
        text = f"{len(found)} samples replaced, at (off by): {', '.join(found[:20])}{more}"
        return [repaired], text

    def losses(self, before: list[Recording], after: list[Recording]) -> list[str]:
        pairs = [
            (getattr(old, name), getattr(new, name))
            for old, new in zip(before, after, strict=True)
            for name in self.signals
            if getattr(old, name) is not None
        ]
        replaced = np.concatenate([(old != new).any(axis=1) for old, new in pairs]).mean()
        texts = super().losses(before, after)
        if replaced > _MANY:
            texts.append(
                f"{100 * (1 - replaced):.0f} % of the rows are left as they were: the threshold is "
                "below the noise, or below the motion within a window"
            )
        return texts


@dataclass(frozen=True)
class InterpolateHeld(Step):
    """Straight lines between updates of a sensor that is read more slowly than the log is written.

    A value that repeats the one before is stale, up to ``longest`` repeats in a row; a longer
    stand-still is kept as it is. Each column is treated alone.

    Args:
        longest: the most repeats in a row that are taken for stale values, or their time, such as
            ``"80 ms"``.
        signals: which of q, v and u.
    """

    longest: Length
    signals: Sequence[str] = ("u",)

    def __post_init__(self) -> None:
        check_signals(self.signals)
        check_window("InterpolateHeld", self.longest, 1, key="longest")

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        shares: list[float] = []
        longest = window_samples(self.longest, recording, 1)

        def draw(x: np.ndarray) -> np.ndarray:
            columns = []
            for column in x.T:
                held = np.r_[False, column[1:] == column[:-1]]
                edges = np.flatnonzero(np.diff(np.r_[False, held, False])).reshape(-1, 2)
                for first, end in edges:
                    # At the end of the log no update follows that a line could lead to.
                    if end - first > longest or end == len(column):
                        held[first:end] = False
                shares.append(float(held.mean()))
                columns.append(np.interp(recording.t, recording.t[~held], column[~held]))
            return np.column_stack(columns)

        drawn = change(recording, self.signals, draw)
        text = (
            f"{100 * min(shares):.0f} to {100 * max(shares):.0f} % of the values of "
            f"{', '.join(self.signals)} were held and are interpolated"
        )
        return [drawn], text


@dataclass(frozen=True)
class SubtractStart(Step):
    """q minus its mean over the first ``samples`` samples, for sensors that drift between runs.

    Right only where every run starts at rest in the same pose.

    Args:
        samples: number of samples at rest, or their time, such as ``"0.5 s"``.
    """

    samples: Length

    def __post_init__(self) -> None:
        check_window("SubtractStart", self.samples, 1, key="samples")

    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        start = recording.q[: window_samples(self.samples, recording, 1)].mean(axis=0)
        shown = ", ".join(f"{value:.4g}" for value in start)
        return [replace(recording, q=recording.q - start)], f"subtracted ({shown}) from q"
