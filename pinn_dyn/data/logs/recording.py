"""A stretch of a log in SI units, and the report of its cleaning."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from pinn_dyn import wording
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.measurement import Measurement

SIGNALS: tuple[Literal["q", "v", "u"], ...] = ("q", "v", "u")
_ROUND = (1, 2, 2.5, 4, 5, 8, 10)  # round rates; usual pieces are a multiple of their sample time
_LONGEST_GAP = 10  # longest gap that is interpolated, in sample times
_GAP_BURSTS, _MANY = 3, 5000  # usual bursts in a gap; rows for a quantile of 0.999
_CLOCK_TOLERANCE = 0.02  # error of rounded times, in sample times


def clock_steps(t: np.ndarray) -> str:
    """Return the text of cleaning steps for a uniform clock, for times ``(T,)`` in s.

    The rate is a round number near the usual rate. SplitGaps splits all gaps that Resample does not
    accept.
    """
    spacing = np.diff(t)
    usual = float(np.median(spacing[spacing > 0]))
    rate = round_rate(usual)
    digit = 10 ** (np.floor(np.log10(_LONGEST_GAP * usual)) - 1)
    gap = digit * np.ceil(_LONGEST_GAP * usual / digit)
    gap, rate = float(f"{gap:.3g}"), float(f"{rate:.6g}")
    lines = [wording.line("deduplicate", wording.step("Deduplicate"))] * int(0 in spacing)
    lines += [
        wording.line("split_gaps", wording.step("SplitGaps", longest=gap)),
        wording.line("resample", wording.step("Resample", rate=rate, max_gap=gap)),
    ]
    return f"\n\n{wording.steps(lines)}"


def burst_steps(t: np.ndarray) -> list[str]:
    """Return lines of cleaning steps for stamps in bursts, ``(T,)`` in s.

    The rate is the rate of rows between gaps. A gap is longer than usual bursts. The rate is
    rounded if the stamps allow it.
    """
    spacing = np.diff(t)
    burst = float(np.quantile(spacing, 0.999 if len(t) > _MANY else 0.95))
    inside = (spacing >= 0) & (spacing <= _GAP_BURSTS * burst)
    written = np.cumsum(np.where(inside, spacing, burst))
    rows = np.arange(len(written))
    rate = 1 / float(np.polyfit(rows, written, 1)[0])
    rounded = float(f"{rate:.3g}")
    distance = written - rows / rounded
    rate = rounded if np.ptp(distance) < 3 * burst else rate
    step = wording.step("RowClock", rate=float(f"{rate:.7g}"), longest=float(f"{2 * burst:.2g}"))
    lines = [wording.line("row_clock", step)]
    if not inside.all():
        longest = float(f"{_GAP_BURSTS * burst:.2g}")
        lines.insert(0, wording.line("split_gaps", wording.step("SplitGaps", longest=longest)))
    return lines


def round_rate(sample_time: float) -> float:
    """Return a round rate in Hz near the rate of a sample time in s."""
    decade = 10 ** np.floor(-np.log10(sample_time))
    return min((float(decade * x) for x in _ROUND), key=lambda x: abs(np.log(x * sample_time)))


@dataclass(frozen=True)
class Recording:
    """A stretch of one run of a log.

    Attributes:
        run: name of the run.
        t: times, ``(T,)``, s.
        q: configuration, ``(T, N)``.
        v: velocity, ``(T, N)``, or None before it is derived.
        u: input, ``(T, M)``.
        past: the samples directly before the stretch, or None.
    """

    run: str
    t: np.ndarray
    q: np.ndarray
    v: np.ndarray | None
    u: np.ndarray
    past: Recording | None = None

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
        """Return all signals in a matrix, ``(T, 2N + M)``, or ``(T, N + M)`` without v."""
        return np.hstack([x for x in (self.q, self.v, self.u) if x is not None])

    def change(
        self, signals: Sequence[str], function: Callable[[np.ndarray], np.ndarray]
    ) -> Recording:
        """Apply a function, ``(T, K) -> (T, K)``, to signals of the recording."""
        values = {name: getattr(self, name) for name in signals}
        changed: Any = {name: function(x) for name, x in values.items() if x is not None}
        return replace(self, **changed)

    def sample_time(self, user: str) -> float:
        """Return the sample time of a uniform clock, s.

        Raises:
            LogError: if the clock is not uniform. The message names the ``user`` of the clock.
        """
        t = self.t
        if len(t) < 2:
            raise LogError(f"{self.run}: {user} needs at least 2 samples, got {len(t)}")
        step = float(t[-1] - t[0]) / (len(t) - 1)
        error = np.abs(t - t[0] - step * np.arange(len(t)))
        k = int(error.argmax())
        if not step > 0 or error[k] > _CLOCK_TOLERANCE * step:
            raise LogError(
                f"{self.place}: {user} needs a uniform clock, but near t = {t[k]:.6g} s the time "
                f"is {error[k]:.3g} s off a clock of {step:.6g} s: put a Resample step before it, "
                f"such as{clock_steps(t)}"
            )
        return step


@dataclass
class Report:
    """Measurements of the checks, and notes of each step on each run."""

    name: str
    measurements: list[Measurement] = field(default_factory=list)
    sections: dict[str, dict[str, list[str]]] = field(default_factory=dict)

    def add(self, section: str, run: str, text: str) -> None:
        """Add a note on a run to a section."""
        self.sections.setdefault(section, {}).setdefault(text, []).append(run)

    def warn(self, name: str, text: str) -> None:
        """Add a warning."""
        self.measurements.append(Measurement(name, verdict="warning", text=text))

    @property
    def warnings(self) -> list[str]:
        """Texts of all measurements with a warning."""
        return list(dict.fromkeys(x.text for x in self.measurements if x.verdict != "ok"))

    def markdown(self) -> str:
        """Return the report with the warnings first."""
        lines = [f"# {self.name}: what was done to the log", "", "## Warnings", ""]
        lines += [f"- {text}" for text in self.warnings] or ["- none"]
        for section, texts in self.sections.items():
            lines += ["", f"## {section}", ""]
            for text, places in texts.items():
                names = ", ".join(places)
                if len(places) > 3:
                    names = f"{len(places)} stretches, {places[0]} ... {places[-1]}"
                lines.append(f"- {names}: {text}")
        return "\n".join(lines) + "\n"
