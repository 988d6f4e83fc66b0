"""From cleaned recordings to trajectories: one sample time, pieces of one length."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording, Report
from pinn_dyn.data.logs.splits import Part
from pinn_dyn.data.logs.step import sample_time
from pinn_dyn.mechanics import Interpolation, Signal, Trajectory

# Inputs before a piece that are kept for models of a delay, s.
PAST = 0.5


@dataclass(frozen=True)
class Cleaned:
    """A stretch of a run before and after the cleaning, for a figure.

    Attributes:
        split: train, validation or test.
        raw: the stretch as it was read, in SI units.
        clean: what the steps made of it, on the same clock.
    """

    split: str
    raw: Recording
    clean: list[Recording]


def long_enough(
    name: str, cleaned: Sequence[Cleaned], least: Mapping[str, tuple[str, float]], report: Report
) -> list[Cleaned]:
    """Without the stretches that a step left too short to be of use.

    Args:
        name: of the step.
        cleaned: all stretches.
        least: for each split what sets the shortest stretch, and how long it is, s.
        report: takes a warning of each that is dropped.

    Raises:
        LogError: where nothing of a split is left.
    """
    result = []
    for part in cleaned:
        key, shortest = least[part.split]
        kept = []
        for item in part.clean:
            # Half a sample: times are rounded.
            if len(item) > 1 and item.duration >= shortest - 0.5 * (item.t[1] - item.t[0]):
                kept.append(item)
            else:
                report.warn(
                    f"{part.split} {item.place} after {name}: {item.duration:.4g} s, less "
                    f"than {key}, {shortest:g} s: dropped"
                )
        result.append(replace(part, clean=kept))
    for split, (key, shortest) in least.items():
        if not any(part.clean for part in result if part.split == split):
            raise LogError(
                f"{split}: after {name} no stretch is as long as {key}, {shortest:g} s: "
                "lower it, or loosen the steps (the warnings name the stretches)"
            )
    return result


def one_sample_time(cleaned: Sequence[Cleaned]) -> float:
    """The sample time that all stretches share, s.

    Raises:
        LogError: if one has another.
    """
    every = [item for part in cleaned for item in part.clean]
    times = [sample_time(item, "a data set") for item in every]
    shared = float(np.median(times))
    for item, step in zip(every, times, strict=True):
        # Rounded times leave the sample time of a short stretch uncertain.
        if abs(step / shared - 1) > max(1e-3, 0.05 / (len(item) - 1)):
            raise LogError(
                f"{item.place}: its sample time is {step:.9g} s, that of the others "
                f"{shared:.9g} s: add a Resample step"
            )
    return shared


def pieces_of(
    name: str, part: Part, cleaned: Sequence[Cleaned], step: float, report: Report
) -> list[Recording]:
    """Roll-outs of one length, or whole stretches; neighbours share a sample, or two.

    A stretch of T samples that lasts one sample less than n pieces has n of them all the same.

    Args:
        name: of the split, such as test.
        part: its description.
        cleaned: all stretches.
        step: their sample time, s.
        report: told what is left over.

    Raises:
        LogError: if the pieces are no multiple of the sample time, or longer than every stretch.
    """
    stretches = [item for one in cleaned if one.split == name for item in one.clean]
    if isinstance(part.piece, str):
        pieces = [replace(item, past=item.u[:0]) for item in stretches]
        report.add("Splits", name, f"{summary(pieces, step)}, each a roll-out of its own")
        return pieces
    span = round(part.piece / step)
    if span < 1 or abs(span * step - part.piece) > 1e-3 * part.piece:
        raise LogError(
            f"{name}.piece is {part.piece} s, expected a multiple of the sample time, {step:g} s, "
            "or 'whole'"
        )
    pieces = [
        replace(
            item.rows(slice(first, first + span + 1)),
            past=item.u[max(first - round(PAST / step), 0) : first],
        )
        for item in stretches
        for first in _starts(len(item), span)
    ]
    if not pieces:
        longest = max(item.duration for item in stretches)
        raise LogError(
            f"{name}: no stretch is as long as a piece of {part.piece} s, the longest has "
            f"{longest:.6g} s: use a shorter piece"
        )
    rest = sum(item.duration for item in stretches) - len(pieces) * span * step
    report.add(
        "Splits",
        name,
        f"{summary(pieces, step)}, each a roll-out of its own; {max(rest, 0):.4g} s are left "
        "over and dropped",
    )
    return pieces


def trajectory(recording: Recording, step: float, interpolation: Interpolation) -> Trajectory:
    """A recording as tensors, from t = 0 on."""
    q, v, u = (
        torch.from_numpy(np.ascontiguousarray(values))
        for values in (recording.q, recording.v, recording.u)
    )
    t = torch.arange(len(recording), dtype=torch.float64) * step
    past = None if recording.past is None else torch.from_numpy(recording.past.copy())
    return Trajectory(q, v, Signal(t, u, interpolation), past=past)


def _starts(samples: int, span: int) -> list[int]:
    """First samples of the pieces of ``span`` + 1 samples that a stretch is cut into."""
    number = samples // span
    if number * span < samples:
        return [k * span for k in range(number)]
    # One sample is missing for as many: two neighbours overlap by it.
    last = samples - 1 - span
    return [round(k * last / (number - 1)) for k in range(number)] if number > 1 < span else []


def summary(recordings: Sequence[Recording], step: float) -> str:
    """How many and how long they are, in words."""
    lengths = [recording.duration for recording in recordings]
    return (
        f"{len(recordings)} trajectories of {min(lengths):.6g} to {max(lengths):.6g} s, "
        f"{sum(lengths):.6g} s in all, sample time {step:.6g} s"
    )
