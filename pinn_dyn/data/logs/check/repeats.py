"""Motions of the validation and the test that occur in another split too."""

from __future__ import annotations

from collections import Counter

import numpy as np
import scipy

from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.data.logs.recording import Recording

_SAME = 0.05  # distance of a repeated motion, as a share of its spread


def check_repeats(
    earlier: list[Recording], pieces: list[Recording], name: str
) -> list[Measurement]:
    """Count the rollouts of the split ``name`` that repeat a motion of the splits before it.

    At a shift s, the mean of ‖q(t) - q_earlier(t + s)‖² is below 0.05² times the variance of q.
    """
    pairs = Counter(
        (piece.run, item.run) for piece in pieces for item in earlier if _is_in(piece, item)
    )
    title = f"motions of the {name} that repeat one of another split"
    results = []
    for (run, original), count in pairs.items():
        text = (
            f"{name}: {count} of the motions of {run} repeat one of {original}, of another "
            "split: keep such runs in one split"
        )
        results.append(
            judged(title, run, count, "0", True, text, section="docs/csv_logs.md#splits")
        )
    return results or [judged(title, name, 0, "0", False, "")]


def _is_in(piece: Recording, item: Recording) -> bool:
    cut_out = piece.run == item.run and item.t[0] <= piece.t[0] <= item.t[-1]
    if cut_out or len(item) < len(piece):
        return False
    thin = max(1, len(piece) // 300)
    q = piece.q[::thin]
    center = q.mean(axis=0)
    q = q - center
    size = (q**2).sum()
    for start in range(0, thin, max(1, thin // 4)):
        track = item.q[start::thin] - center
        if len(track) >= len(q):
            squares = np.cumsum(np.r_[0.0, (track**2).sum(axis=1)])
            energy = squares[len(q) :] - squares[: -len(q)]
            products = scipy.signal.fftconvolve(track, q[::-1], mode="valid", axes=0).sum(axis=1)
            if (energy - 2 * products + size < _SAME**2 * size).any():
                return True
    return False
