"""The contract of a cleaning step."""

from __future__ import annotations

import abc
from collections.abc import Collection, Sequence
from typing import Literal

import numpy as np

from pinn_dyn.data.lengths import Length, seconds_of
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import SIGNALS, Recording

Signals = Sequence[Literal["q", "v", "u"]]
"""Signals that a step changes."""
# A step that leaves a smaller share of the time, or of a signal's spread, causes a warning.
_LEAST_SHARE = 0.5


class Step(abc.ABC):
    """One step of the cleaning: maps a recording to recordings and a note for the report."""

    @property
    def repairs(self) -> Collection[str]:
        """Faults of a log that the step repairs, and that are then no errors.

        These are ``"gaps"``, ``"repeated times"``, ``"backward times"``, ``"bursts"`` of stamps,
        and ``"jumps of q"`` (v, u).
        """
        return ()

    @abc.abstractmethod
    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        """Return the cleaned recordings, and a note on what was done.

        Raises:
            LogError: if the step cannot be applied; says what to do first.
        """

    def losses(self, before: list[Recording], after: list[Recording]) -> list[str]:
        """Return warnings about data that the step destroyed: time, or the spread of a signal."""
        warnings = []
        seconds, seconds_left = (sum(item.duration for item in items) for items in (before, after))
        if seconds_left < _LEAST_SHARE * seconds:
            warnings.append(f"{seconds_left:.4g} s of {seconds:.4g} s are left")
        for name in SIGNALS if after else ():
            spreads = [
                np.vstack([getattr(item, name) - getattr(item, name).mean(0) for item in items])
                for items in (before, after)
                if all(getattr(item, name) is not None for item in items)
            ]
            if len(spreads) == 2:
                spread, spread_left = (values.std(axis=0) for values in spreads)
                spread_left = spread_left[: len(spread)]
                for k in np.flatnonzero(spread_left < _LEAST_SHARE * spread):
                    share = 100 * spread_left[k] / spread[k]
                    warnings.append(
                        f"column {k + 1} of {name} has {share:.2g} % of its spread left"
                    )
        return warnings

    def input_labels(self, labels: list[str]) -> list[str]:
        """Return names and units of the inputs after the step, from the names before it."""
        return labels


def window_samples(window: Length, recording: Recording, least: int, *, odd: bool = False) -> int:
    """Return the number of samples of a window in a recording.

    Args:
        window: number of samples, or a time such as ``"50 ms"``, which is rounded.
        recording: the recording.
        least: smallest number of samples.
        odd: if the number must be odd.

    Raises:
        LogError: if a number of samples is too small, or even where it must be odd.
    """
    if isinstance(window, str):
        count = seconds_of("window", window) / float(np.median(np.diff(recording.t)))
        return max(2 * round((count - 1) / 2) + 1 if odd else round(count), least)
    if window < least or (odd and window % 2 == 0):
        raise LogError(
            f"a window is {window}, expected {'an odd' if odd else 'a'} number of samples, at "
            f"least {least}, or a time, such as '0.1 s'"
        )
    return window
