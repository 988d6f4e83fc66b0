"""Cleaning of the stretches of a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.filters import SavitzkyGolayVelocity
from pinn_dyn.data.logs.pieces import Cleaned
from pinn_dyn.data.logs.recording import Report
from pinn_dyn.data.logs.step import Step


def clean(
    cleaned: list[Cleaned],
    steps: Mapping[str, Step],
    report: Report,
    limits: Mapping[str, float] | None = None,
) -> list[Cleaned]:
    """Apply the steps and derive a missing velocity. Drop stretches shorter than ``limits``, s."""
    for name, step in steps.items():
        cleaned = _apply(name, step, cleaned, report)
        if limits is not None:
            cleaned = long_enough(name, cleaned, limits, report)
    if any(item.v is None for part in cleaned for item in part.clean):
        cleaned = _apply("velocity", SavitzkyGolayVelocity(), cleaned, report)
    return cleaned


def long_enough(
    name: str, cleaned: list[Cleaned], limits: Mapping[str, float], report: Report
) -> list[Cleaned]:
    """Drop stretches that are shorter than the limit of their split, s, after a step."""
    result = []
    for part in cleaned:
        limit = limits[part.split]
        clean = []
        for item in part.clean:
            # Tolerate half a sample, since times are rounded.
            if len(item) > 1 and item.duration >= limit - 0.5 * (item.t[1] - item.t[0]):
                clean.append(item)
                continue
            text = f"{item.duration:.4g} s, shorter than {limit:g} s (piece or shortest)"
            report.warn("length", f"{part.split} {item.place} after {name}: {text}: dropped")
        result.append(replace(part, clean=clean))
    for key in limits.keys() - {part.split for part in result if part.clean}:
        raise LogError(
            f"{key}: after {name} no stretch lasts {limits[key]:g} s: lower piece or shortest"
        )
    return result


def _apply(name: str, step: Step, cleaned: Sequence[Cleaned], report: Report) -> list[Cleaned]:
    result = []
    for part in cleaned:
        clean = []
        for recording in part.clean:
            try:
                stretches, text = step.apply(recording)
            except ValueError as error:  # LogError, or an error of SciPy, as for too few samples
                raise LogError(f"{recording.place}, step {name}: {error}") from error
            report.add(f"{name}: {step}", f"{part.split} {recording.place}", text)
            clean += stretches
        result.append(replace(part, clean=clean))
    return result
