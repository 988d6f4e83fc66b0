"""The same motions of a log for models whose inputs were prepared differently."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import torch

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.pieces import PAST, one_sample_time, pieces_of
from pinn_dyn.data.logs.recording import Recording, Report
from pinn_dyn.data.logs.source import LogSource
from pinn_dyn.mechanics import Signal, Trajectory

log = logging.getLogger(__name__)

_ROUNDED = 1e-6
"""Of a sample time: how far apart equal times of two clocks may be."""
_OTHER = 0.2
"""Part of the spread of a coordinate by which no filter moves its mean."""


def common_motions(sources: Sequence[LogSource], split: str) -> list[list[Trajectory]]:
    """The motions of a split, q, v and times of the first source, and the inputs of each source.

    A source's u is its signal between its own samples, at the times of the first. Where one of them
    has no input, as at the start of a run whose inputs were delayed, the motion is cut.

    Args:
        sources: of the same files, coordinates and splits.
        split: validation or test.

    Returns:
        For each source the trajectories, in the same order and at the same times.

    Raises:
        LogError: if there is no motion for which all of them have inputs, or a step of one of them
            makes other coordinates of q.
    """
    first = sources[0]
    step = one_sample_time(first.cleaned)
    pieces = pieces_of(split, getattr(first, split), first.cleaned, step, Report(first.name))
    found: list[list[Trajectory]] = [[] for _ in sources]
    for piece in pieces:
        stretches = [_longest_overlap(source, split, piece) for source in sources]
        if None in stretches:
            continue
        known = [stretch for stretch in stretches if stretch is not None]
        start, end = (max(x.t[0] for x in known), min(x.t[-1] for x in known))
        slack = _ROUNDED * step
        kept = piece.rows((piece.t >= start - slack) & (piece.t <= end + slack))
        if len(kept) < 2:
            continue
        for source, stretch, trajectories in zip(sources, known, found, strict=True):
            _check_coordinates(kept, stretch)
            trajectories.append(_with_inputs(kept, stretch, source, step))
    if not found[0]:
        raise LogError(
            f"{split}: no motion has inputs in every preparation of {first.name}: evaluate the "
            "runs separately"
        )
    if missing := len(pieces) - len(found[0]):
        log.warning(
            "%d of %d motions of %s have no inputs in one of the preparations and are left out",
            *(missing, len(pieces), first.name),
        )
    return found


def _longest_overlap(source: LogSource, split: str, piece: Recording) -> Recording | None:
    """The cleaned stretch of a source that shares most of the time of a piece; None without any."""

    def shared(item: Recording) -> float:
        return float(min(item.t[-1], piece.t[-1]) - max(item.t[0], piece.t[0]))

    stretches = [x for one in source.cleaned if one.split == split for x in one.clean]
    best = max((x for x in stretches if x.run == piece.run), key=shared, default=None)
    return best if best is not None and shared(best) > 0 else None


def _check_coordinates(kept: Recording, stretch: Recording) -> None:
    """Refuse a stretch whose q is another one: a model of it would start from the wrong place."""
    own = np.column_stack([np.interp(kept.t, stretch.t, column) for column in stretch.q.T])
    off = np.abs((own - kept.q).mean(axis=0))  # noise that one of them filters has no mean
    spread = stretch.q.std(axis=0)
    for k in np.flatnonzero(off > _OTHER * spread):
        raise LogError(
            f"{kept.place}: the steps of two data sets make coordinate {k + 1} differ by "
            f"{off[k]:.3g}, of a spread of {spread[k]:.3g}: expected steps that shift no "
            "coordinate, as filters, delays and rates. Evaluate the runs separately"
        )


def _with_inputs(kept: Recording, stretch: Recording, source: LogSource, step: float) -> Trajectory:
    """q and v of a piece with the inputs of a stretch around it, from t = 0 on."""
    assert kept.v is not None
    clock, samples = (torch.from_numpy(x.copy()) for x in (stretch.t, stretch.u))
    signal = Signal(clock, samples, source.interpolation)
    # A held input jumps at its samples, whose times may be rounded to either side.
    later = _ROUNDED * step if source.interpolation == "hold" else 0.0
    count = int(min(PAST, kept.t[0] - stretch.t[0]) / step + _ROUNDED)
    before = kept.t[0] - step * np.arange(count, 0, -1)
    u, past = (signal.at(torch.from_numpy(times + later)) for times in (kept.t, before))
    t = torch.arange(len(kept), dtype=torch.float64) * step
    q, v = (torch.from_numpy(x.copy()) for x in (kept.q, kept.v))
    return Trajectory(q, v, Signal(t, u, source.interpolation), past=past)
