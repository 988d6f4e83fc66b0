"""A stretch of a log in SI units, and the report of what happened to it."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

import numpy as np

log = logging.getLogger(__name__)

_SINCE_1970 = 1e8  # s, three years: what is later counts from 1970


@dataclass(frozen=True)
class Recording:
    """A stretch of one run of a log.

    Attributes:
        run: name of the run: its file without suffix, its trajectory id, or both.
        t: the log's own times, ``(T,)``, s; of stamps since 1970, from the first of the run.
        q: configuration, ``(T, N)``.
        v: velocity, ``(T, N)``, or None while there is none.
        u: input, ``(T, M)``.
        past: u of the samples right before, ``(K, M)``, of what was cut out of a longer stretch.
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
        """The run and its times, for messages."""
        return f"{self.run} ({self.t[0]:.6g} to {self.t[-1]:.6g} s)"

    def rows(self, index: Any) -> Recording:
        """The rows that a slice, a mask or positions pick."""
        v = None if self.v is None else self.v[index]
        return Recording(self.run, self.t[index], self.q[index], v, self.u[index])

    def values(self) -> np.ndarray:
        """All signals side by side, ``(T, 2N + M)`` or ``(T, N + M)``."""
        return np.hstack([x for x in (self.q, self.v, self.u) if x is not None])


def since_start(times: np.ndarray) -> tuple[np.ndarray, str]:
    """The clocks of a run, ``(T, C)`` in s, from its start where they are stamps since 1970.

    Messages could not tell two stamps apart by six digits.

    Returns:
        The times, and from when they count, for the report; "" where they are as they were.
    """
    stamps = times[0] > _SINCE_1970
    since = f"; t from the stamp {times[0, 0]:.6f} s" if stamps[0] else ""
    return times - np.where(stamps, times[0], 0.0), since


@dataclass
class Report:
    """What each step did to each run, and what looked wrong, in plain Markdown."""

    name: str
    sections: dict[str, dict[str, list[str]]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def add(self, section: str, place: str, text: str) -> None:
        """A line on one run, under the heading of a step."""
        self.sections.setdefault(section, {}).setdefault(text, []).append(place)

    def warn(self, text: str) -> None:
        """A warning, logged once and kept."""
        if text not in self.warnings:
            self.warnings.append(text)
            log.warning("%s: %s", self.name, text)

    def __str__(self) -> str:
        lines = [f"# {self.name}: what was done to the log", "", "## Warnings", ""]
        lines += [f"- {text}" for text in self.warnings] or ["- none"]
        for section, texts in self.sections.items():
            lines += ["", f"## {section}", ""]
            for text, places in texts.items():
                # Lines that are the same for many runs are one line.
                many = len(places) > 3
                where = f"{len(places)} stretches, {places[0]} ... {places[-1]}" if many else ""
                lines.append(f"- {where or ', '.join(places)}: {text}")
        return "\n".join(lines) + "\n"
