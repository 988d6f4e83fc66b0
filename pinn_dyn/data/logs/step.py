"""The contract of a cleaning step."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording

SIGNALS = ("q", "v", "u")

# A clock counts as uniform if no sample is further than this share of a sample from its place:
# files round their times.
CLOCK_TOLERANCE = 0.02


class Step(abc.ABC):
    """One step of the cleaning: a recording in, one or several out, and a line for the report."""

    def fit(self, training: list[Recording]) -> Step:
        """The step with what it must learn from the data, taken from the training runs alone."""
        return self

    @abc.abstractmethod
    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        """The cleaned recordings, and what was done.

        Raises:
            LogError: if the step cannot be applied; says what to do first.
        """

    def input_labels(self, labels: list[str]) -> list[str]:
        """Names and units of the inputs after the step, given those before it."""
        return labels


def sample_time(recording: Recording, wanted_by: str) -> float:
    """The sample time of a uniform clock, s.

    Raises:
        LogError: if there are fewer than two samples, or the clock is not uniform.
    """
    t = recording.t
    if len(t) < 2:
        raise LogError(f"{recording.run}: {wanted_by} found {len(t)} samples, expected at least 2")
    step = float(t[-1] - t[0]) / (len(t) - 1)
    off = np.abs(t - t[0] - step * np.arange(len(t)))
    if not step > 0 or off.max() > CLOCK_TOLERANCE * step:
        k = int(off.argmax())
        raise LogError(
            f"{recording.place}: {wanted_by} needs a uniform clock, but near t = {t[k]:.6g} s the "
            f"time is {off[k]:.3g} s off a clock of {step:.6g} s: put a Resample step before it"
        )
    return step


def check_signals(signals: Sequence[str]) -> tuple[str, ...]:
    """The signals that a step works on.

    Raises:
        LogError: on anything but q, v and u.
    """
    wrong = [name for name in signals if name not in SIGNALS]
    if wrong or isinstance(signals, str) or not signals:
        raise LogError(f"signals is {signals!r}, expected a list of some of {', '.join(SIGNALS)}")
    return tuple(signals)


def change(
    recording: Recording, signals: Sequence[str], function: Callable[[np.ndarray], np.ndarray]
) -> Recording:
    """The recording with a function applied to some of its signals, ``(T, K) -> (T, K)``."""
    changed: dict[str, Any] = {
        name: function(getattr(recording, name))
        for name in signals
        if getattr(recording, name) is not None
    }
    return replace(recording, **changed)
