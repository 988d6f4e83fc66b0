"""Trajectories from cleaned recordings, with a common sample time and length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.logs.splits import Part
from pinn_dyn.mechanics import Interpolation, Signal, Trajectory

_PAST = 2.0  # s before a piece that are kept for models of a delay or with a memory


@dataclass(frozen=True)
class Cleaned:
    """A stretch of a run before and after the cleaning.

    Attributes:
        split: train, validation or test.
        raw: the stretch before the cleaning, in SI units.
        clean: the stretches after the cleaning, with the same clock.
    """

    split: str
    raw: Recording
    clean: list[Recording]


def one_sample_time(items: Sequence[Recording]) -> float:
    """Return the common sample time of all stretches, s."""
    times = [item.sample_time("a data set") for item in items]
    shared = float(np.median(times))
    for item, step in zip(items, times, strict=True):
        # Rounding of times makes the sample time of a short stretch uncertain.
        if abs(step / shared - 1) > max(1e-3, 0.05 / (len(item) - 1)):
            raise LogError(
                f"{item.place}: the sample time is {step:.9g} s, but that of other stretches is "
                f"{shared:.9g} s: add a Resample step"
            )
    return shared


def pieces_of(
    name: str, part: Part, stretches: Sequence[Recording], step: float
) -> tuple[list[Recording], str]:
    """Cut the cleaned stretches of a split into rollouts; return the rollouts and a note.

    Raises:
        LogError: if the piece is no multiple of the sample time.
    """
    if part.piece == "whole":
        pieces = list(stretches)
        return pieces, f"{summary(pieces, step)}, each one rollout"
    assert part.piece is not None, "chosen by fitting()"
    span = round(part.piece / step)
    if span < 1 or abs(span * step - part.piece) > 1e-3 * part.piece:
        raise LogError(
            f"{name}.piece is {part.piece} s, expected a multiple of the sample time, {step:g} s"
        )
    pieces = []
    for item in stretches:
        for first in _starts(len(item), span):
            past = item.rows(slice(max(first - round(_PAST / step), 0), first))
            pieces.append(replace(item.rows(slice(first, first + span + 1)), past=past))
    unused = max(sum(item.duration for item in stretches) - len(pieces) * span * step, 0)
    return pieces, f"{summary(pieces, step)}, each one rollout; {unused:.4g} s are dropped"


def _starts(samples: int, span: int) -> list[int]:
    """Return the first sample of each piece of ``span`` + 1 samples in a stretch."""
    last, count = samples - 1 - span, samples // span
    stride = min(span, last / max(count - 1, 1))
    return [round(k * stride) for k in range(count)] if last >= 0 else []


def trajectory(recording: Recording, step: float, interpolation: Interpolation) -> Trajectory:
    """Return a recording as a trajectory that starts at t = 0."""
    assert recording.v is not None
    q, v, u = (torch.from_numpy(x.copy()) for x in (recording.q, recording.v, recording.u))
    t = torch.arange(len(recording), dtype=torch.float64) * step
    past, past_q = None, None
    if recording.past is not None:
        past, past_q = (torch.from_numpy(x.copy()) for x in (recording.past.u, recording.past.q))
    return Trajectory(q, v, Signal(t, u, interpolation), past=past, past_q=past_q)


def summary(recordings: Sequence[Recording], step: float) -> str:
    """Return the number and lengths of recordings for the report."""
    lengths = [recording.duration for recording in recordings]
    return (
        f"{len(recordings)} trajectories of {min(lengths):.6g} to {max(lengths):.6g} s, "
        f"{sum(lengths):.6g} s in all, sample time {step:.6g} s"
    )
