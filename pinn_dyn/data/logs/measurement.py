"""A measurement of a log check with its verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["ok", "warning", "stop"]


@dataclass(frozen=True)
class Measurement:
    """A number that a check measured, and its meaning for a training.

    Attributes:
        name: measured quantity.
        place: run, column or input.
        value: the number.
        expected: range of a log without faults.
        verdict: ``"ok"``, ``"warning"``, or ``"stop"`` if the log is not suitable for training.
        text: explanation, unless the verdict is ``"ok"``.
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
    """Return a measurement with the verdict and text if ``bad``, otherwise with ``"ok"``."""
    verdict, text = (verdict, text) if bad else ("ok", "")
    return Measurement(name, place, float(value), expected, verdict, text, section)
