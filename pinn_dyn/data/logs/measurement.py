"""One measurement of a log check, with its verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["ok", "warning", "stop"]


@dataclass(frozen=True)
class Measurement:
    """A number that a check measured, and its meaning for a training.

    Attributes:
        name, place, value, expected: quantity; run, column or input; number; range of a good log.
        verdict, text: ``"stop"`` if a training makes no sense; a sentence unless ``"ok"``.
        section: section of the documentation.
    """

    name: str
    place: str = ""
    value: float = float("nan")
    expected: str = ""
    verdict: Verdict = "ok"
    text: str = ""
    section: str = "docs/csv_logs.md#checks-when-a-log-is-read"


def judged(
    name: str,
    place: str,
    value: float,
    expected: str,
    bad: bool,
    text: str,
    verdict: Verdict = "warning",
    section: str = Measurement.section,
) -> Measurement:
    """Return a measurement with a verdict and a text if it is bad, else ``"ok"``."""
    verdict, text = (verdict, text) if bad else ("ok", "")
    return Measurement(name, place, float(value), expected, verdict, text, section)
