"""The contract of a cleaning step."""

from __future__ import annotations

import abc
from collections.abc import Collection, Sequence
from typing import Literal

import numpy as np

from pinn_dyn.data.lengths import Length, seconds_of
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording

Signals = Sequence[Literal["q", "v", "u"]]
"""Signals that a step changes."""


class Step(abc.ABC):
    """A cleaning step, which maps a recording to recordings and a note for the report.

    Attributes:
        repairs: faults that the step repairs. The checks do not report them: ``"gaps"``,
            ``"repeated times"``, ``"bursts"``, ``"jumps of q"``.
    """

    repairs: Collection[str] = ()

    @abc.abstractmethod
    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        """Return the cleaned recordings, and a note on the changes.

        Raises:
            LogError: if the step cannot be applied. The message names the remedy.
        """

    def input_labels(self, labels: list[str]) -> list[str]:
        """Return names and units of the inputs after the step, from those before the step."""
        return labels


def window_samples(window: Length, recording: Recording, minimum: int, *, odd: bool = False) -> int:
    """Convert a window to a number of samples. A time is rounded, to at least ``minimum`` samples.

    Raises:
        LogError: if a number of samples is smaller than ``minimum``, or even if it must be odd.
    """
    if isinstance(window, str):
        count = seconds_of("window", window) / float(np.median(np.diff(recording.t)))
        return max(2 * round((count - 1) / 2) + 1 if odd else round(count), minimum)
    if window < minimum or (odd and window % 2 == 0):
        kind = "an odd" if odd else "a"
        raise LogError(f"window is {window}, expected {kind} number of at least {minimum} samples")
    return window
