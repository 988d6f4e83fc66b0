"""A stretch of a log in SI units, and the report of what the cleaning did to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from pinn_dyn.data.logs.errors import LogError

SIGNALS: tuple[Literal["q", "v", "u"], ...] = ("q", "v", "u")
_SINCE_1970 = 1e8  # s, three years: later times count from 1970
# A clock counts as uniform if every sample is within this share of a sample of its place: files
# round their times.
_CLOCK_TOLERANCE = 0.02


@dataclass(frozen=True)
class Recording:
    """A stretch of one run of a log.

    Attributes:
        run: name of the run: its file without suffix, its trajectory id, or both.
        t: times of the log, ``(T,)``, s; of stamps since 1970, from the first of the run.
        q: configuration, ``(T, N)``.
        v: velocity, ``(T, N)``, or None while there is none.
        u: input, ``(T, M)``.
        past: u of the samples right before, ``(K, M)``, of a stretch cut out of a longer one.
    """

    run: str
    t: np.ndarray
    q: np.ndarray
    v: np.ndarray | None
    u: np.ndarray
    past: np.ndarray | None = None

    def __len__(self) -> int:
        return self.t.shape[0]

    @property
    def duration(self) -> float:
        """Time from the first to the last sample, s."""
        return float(self.t[-1] - self.t[0])

    @property
    def place(self) -> str:
        """Run and times, for messages."""
        return f"{self.run} ({self.t[0]:.6g} to {self.t[-1]:.6g} s)"

    def rows(self, index: Any) -> Recording:
        """Return the rows of a slice, a mask or positions."""
        v = None if self.v is None else self.v[index]
        return Recording(self.run, self.t[index], self.q[index], v, self.u[index])

    def values(self) -> np.ndarray:
        """Return all signals side by side, ``(T, 2N + M)`` or ``(T, N + M)``."""
        return np.hstack([x for x in (self.q, self.v, self.u) if x is not None])

    def change(
        self, signals: Sequence[str], function: Callable[[np.ndarray], np.ndarray]
    ) -> Recording:
        """Return the recording with a function applied to signals, ``(T, K) -> (T, K)``."""
        changed: dict[str, Any] = {
            name: function(getattr(self, name))
            for name in signals
            if getattr(self, name) is not None
        }
        return replace(self, **changed)

    def sample_time(self, user: str) -> float:
        """Return the sample time of a uniform clock, s.

        Args:
            user: name of the step that needs it, for the message.

        Raises:
            LogError: if there are fewer than two samples, or the clock is not uniform.
        """
        t = self.t
        if len(t) < 2:
            raise LogError(f"{self.run}: {user} needs at least 2 samples, got {len(t)}")
        step = float(t[-1] - t[0]) / (len(t) - 1)
        error = np.abs(t - t[0] - step * np.arange(len(t)))
        if not step > 0 or error.max() > _CLOCK_TOLERANCE * step:
            k = int(error.argmax())
            raise LogError(
                f"{self.place}: {user} needs a uniform clock, but near t = {t[k]:.6g} s the time "
                f"is {error[k]:.3g} s off a clock of {step:.6g} s: put a Resample step before it, "
                f"as {{_target_: pinn_dyn.data.logs.Resample, rate: {float(f'{1 / step:.3g}')}, "
                f"max_gap: {max(float(np.diff(t).max()), step):.2g}}}"
            )
        return step


def since_start(times: np.ndarray) -> tuple[np.ndarray, str]:
    """Count clocks of a run, ``(T, C)`` in s, from its start if they are stamps since 1970.

    Returns:
        The times, and a remark for the report, "" if the times are unchanged.
    """
    stamps = times[0] > _SINCE_1970
    remark = f"; t from the stamp {times[0, 0]:.6f} s" if stamps[0] else ""
    return times - np.where(stamps, times[0], 0.0), remark


@dataclass
class Report:
    """Notes on what each step did to each run, as Markdown."""

    name: str
    sections: dict[str, dict[str, list[str]]] = field(default_factory=dict)

    def add(self, section: str, place: str, text: str) -> None:
        """Add a note on one run to a section."""
        self.sections.setdefault(section, {}).setdefault(text, []).append(place)

    def markdown(self, warnings: Sequence[str]) -> str:
        """Return the report with the warnings first."""
        lines = [f"# {self.name}: what was done to the log", "", "## Warnings", ""]
        lines += [f"- {text}" for text in warnings] or ["- none"]
        for section, texts in self.sections.items():
            lines += ["", f"## {section}", ""]
            for text, places in texts.items():
                # Notes that are the same for many runs are one line.
                many = len(places) > 3
                summary = f"{len(places)} stretches, {places[0]} ... {places[-1]}" if many else ""
                lines.append(f"- {summary or ', '.join(places)}: {text}")
        return "\n".join(lines) + "\n"
