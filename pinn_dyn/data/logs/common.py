"""The same motions of a log for models whose inputs were prepared differently."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import torch

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.pieces import PAST, one_sample_time, pieces_of
from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.logs.source import LogSource
from pinn_dyn.mechanics import Signal, Trajectory

log = logging.getLogger(__name__)

_ROUNDED = 1e-6
"""Largest distance between equal times of two clocks, in sample times."""
_SHIFTED = 0.2
"""Share of the spread of a coordinate by which no filter moves its mean."""


def common_motions(sources: Sequence[LogSource], split: str) -> list[list[Trajectory]]:
    """Return the motions of a split: q, v, times of the first source, inputs of each source.

    The u of a source is its signal between its samples, at the times of the first source. Where a
    source has no input, as at the start of a run with delayed inputs, the motion is cut.

    Args:
        sources: sources of the same files, coordinates and splits.
        split: validation or test.

    Returns:
        For each source the trajectories, in the same order and at the same times.

    Raises:
        LogError: if the sources have no motion in common, or differ in a coordinate of q.
    """
    first = sources[0]
    step = one_sample_time(first.cleaned)
    pieces, _ = pieces_of(split, getattr(first, split), first.cleaned, step)
    motions: list[list[Trajectory]] = [[] for _ in sources]
    for piece in pieces:
        overlaps = [_longest_overlap(source, split, piece) for source in sources]
        stretches = [stretch for stretch in overlaps if stretch is not None]
        if len(stretches) < len(sources):
            continue
        start, end = (max(x.t[0] for x in stretches), min(x.t[-1] for x in stretches))
        slack = _ROUNDED * step
        shared = piece.rows((piece.t >= start - slack) & (piece.t <= end + slack))
        if len(shared) < 2:
            continue
        for source, stretch, trajectories in zip(sources, stretches, motions, strict=True):
            _check_coordinates(shared, stretch)
            trajectories.append(_with_inputs(shared, stretch, source, step))
    if not motions[0]:
        raise LogError(
            f"{split}: no motion has inputs in every preparation of {first.name}: evaluate the "
            "runs separately"
        )
    if missing := len(pieces) - len(motions[0]):
        log.warning(
            "%d of %d motions of %s have no inputs in one of the preparations and are left out",
            *(missing, len(pieces), first.name),
        )
    return motions


def _longest_overlap(source: LogSource, split: str, piece: Recording) -> Recording | None:
    """Return the cleaned stretch of a source that overlaps a piece the longest, or None."""

    def shared(item: Recording) -> float:
        return float(min(item.t[-1], piece.t[-1]) - max(item.t[0], piece.t[0]))

    stretches = [x for part in source.cleaned if part.split == split for x in part.clean]
    best = max((x for x in stretches if x.run == piece.run), key=shared, default=None)
    return best if best is not None and shared(best) > 0 else None


def _check_coordinates(piece: Recording, stretch: Recording) -> None:
    """Refuse a stretch with another q: a model of it would start from the wrong state."""
    q = np.column_stack([np.interp(piece.t, stretch.t, column) for column in stretch.q.T])
    shift = np.abs((q - piece.q).mean(axis=0))  # filtered noise has no mean
    spread = stretch.q.std(axis=0)
    for k in np.flatnonzero(shift > _SHIFTED * spread):
        raise LogError(
            f"{piece.place}: the steps of two data sets make coordinate {k + 1} differ by "
            f"{shift[k]:.3g}, of a spread of {spread[k]:.3g}: expected steps that shift no "
            "coordinate, as filters, delays and rates. Evaluate the runs separately"
        )


def _with_inputs(
    piece: Recording, stretch: Recording, source: LogSource, step: float
) -> Trajectory:
    """Return q and v of a piece with the inputs of a stretch around it, from t = 0 on."""
    assert piece.v is not None
    clock, samples = (torch.from_numpy(x.copy()) for x in (stretch.t, stretch.u))
    signal = Signal(clock, samples, source.interpolation)
    # A held input jumps at its samples, whose times may be rounded to either side.
    later = _ROUNDED * step if source.interpolation == "hold" else 0.0
    count = int(min(PAST, piece.t[0] - stretch.t[0]) / step + _ROUNDED)
    before = piece.t[0] - step * np.arange(count, 0, -1)
    u, past = (signal.at(torch.from_numpy(times + later)) for times in (piece.t, before))
    t = torch.arange(len(piece), dtype=torch.float64) * step
    q, v = (torch.from_numpy(x.copy()) for x in (piece.q, piece.v))
    return Trajectory(q, v, Signal(t, u, source.interpolation), past=past)
