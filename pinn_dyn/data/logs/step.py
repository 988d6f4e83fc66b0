"""The contract of a cleaning step."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pinn_dyn.data.lengths import Length, seconds_of
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording

SIGNALS = ("q", "v", "u")

# A clock counts as uniform if no sample is further than this share of a sample from its place:
# files round their times.
CLOCK_TOLERANCE = 0.02


# A step that leaves a smaller share of the time, or of a signal's spread, is warned of.
_LEFT = 0.5


class Step(abc.ABC):
    """One step of the cleaning: a recording in, one or several out, and a line for the report."""

    @property
    def learns(self) -> bool:
        """Whether :meth:`fit` takes something from the training runs."""
        return False

    def fit(self, training: list[Recording]) -> Step:
        """The step with what it must learn from the data, taken from the training runs alone."""
        return self

    @abc.abstractmethod
    def apply(self, recording: Recording) -> tuple[list[Recording], str]:
        """The cleaned recordings, and what was done.

        Raises:
            LogError: if the step cannot be applied; says what to do first.
        """

    def losses(self, before: list[Recording], after: list[Recording]) -> list[str]:
        """What the step destroyed, with what is left: of the time, and of each signal's spread."""
        texts = []
        lasted, left = (sum(item.duration for item in items) for items in (before, after))
        if left < _LEFT * lasted:
            texts.append(f"{left:.4g} s of {lasted:.4g} s are left")
        for name in SIGNALS if after else ():
            spreads = [
                np.vstack([getattr(item, name) - getattr(item, name).mean(0) for item in items])
                for items in (before, after)
                if all(getattr(item, name) is not None for item in items)
            ]
            if len(spreads) < 2:
                continue
            was, now = (values.std(axis=0) for values in spreads)
            for k in np.flatnonzero(now[: len(was)] < _LEFT * was):
                texts.append(
                    f"column {k + 1} of {name} has {100 * now[k] / was[k]:.2g} % of its spread left"
                )
        return texts

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
            f"time is {off[k]:.3g} s off a clock of {step:.6g} s: put a Resample step before it, "
            f"as {{_target_: pinn_dyn.data.logs.Resample, rate: {float(f'{1 / step:.3g}')}, "
            f"max_gap: {max(float(np.diff(t).max()), step):.2g}}}"
        )
    return step


def check_window(
    name: str, window: Length, least: int, *, odd: bool = False, key: str = "window"
) -> None:
    """Refuse a window that is no number of samples, of at least ``least``, and no time.

    Raises:
        LogError: if it is neither; a time is rounded to an odd number where one is needed.
    """
    if isinstance(window, str):
        try:
            seconds_of(f"{name}: {key}", window)
        except ValueError as error:
            raise LogError(str(error)) from error
    elif window < least or (odd and window % 2 == 0):
        kind = "an odd number" if odd else "a number"
        raise LogError(
            f"{name}: {key} is {window}, expected {kind} of samples, at least {least}, or a time, "
            "such as '0.1 s'"
        )


def window_samples(window: Length, recording: Recording, least: int, *, odd: bool = False) -> int:
    """The samples, at least ``least``, that are closest to a window in a recording."""
    if not isinstance(window, str):
        return max(window, least)
    count = seconds_of("window", window) / float(np.median(np.diff(recording.t)))
    return max(2 * round((count - 1) / 2) + 1 if odd else round(count), least)


def check_signals(signals: Sequence[str]) -> None:
    """Refuse signals of a step that are other than q, v and u."""
    wrong = [name for name in signals if name not in SIGNALS]
    if wrong or isinstance(signals, str) or not signals:
        raise LogError(f"signals is {signals!r}, expected a list of some of {', '.join(SIGNALS)}")


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
