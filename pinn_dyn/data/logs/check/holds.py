"""Columns that keep their values for several rows: a sensor or a command slower than the log."""

from __future__ import annotations

import numpy as np

_FEWEST = 20  # updates
_REGULAR = 1.5  # long over short distance of two updates
_TICK = 1.5  # smallest steps, up to which a step is one of an encoder


def held_rows(x: np.ndarray) -> int:
    """Return the rows from one update of columns ``(T, K)`` to the next, 1 if they are not held.

    All columns of a held signal change in the same rows, at regular distances. A slow joint with a
    coarse encoder changes at times, too, but by one step of the encoder.
    """
    steps = np.abs(np.diff(x, axis=0))
    changes = np.flatnonzero(steps.any(axis=1))
    spacing = np.diff(changes)
    if len(spacing) < _FEWEST:
        return 1
    short, usual, long = np.percentile(spacing, [10, 50, 90])
    sizes = steps[changes].max(axis=1)
    ticks = np.mean(sizes <= _TICK * sizes.min())
    if short < 2 or long > _REGULAR * short + 1 or ticks > 0.5:
        return 1
    return int(usual)
