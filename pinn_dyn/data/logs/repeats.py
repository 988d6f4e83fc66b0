"""Motions that occur twice: copies of runs, and test motions that repeat a training motion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np
import scipy

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.data.logs.recording import Recording

_SAME = 0.05  # distance of a repeated motion, as a share of its spread


def refuse_copies(parts: Mapping[str, list[Recording]]) -> None:
    """Raise a LogError on the same numbers in two splits: the test would measure the training."""
    first: dict[int, tuple[str, str]] = {}
    for split, recordings in parts.items():
        for item in recordings:
            content = hash((item.q.tobytes(), item.u.tobytes()))
            split_of_first, run = first.setdefault(content, (split, item.run))
            if split_of_first != split:
                raise LogError(
                    f"{item.run}, in {split}, is a copy of {run}, in {split_of_first}, number by "
                    "number: leave one of them out, or put both into one split"
                )


def check_repeats(
    training: list[Recording], pieces: list[Recording], name: str
) -> list[Measurement]:
    """Count the roll-outs of the split ``name`` that repeat a motion of the training.

    At a shift s, the mean of ‖q_test(t) - q_train(t + s)‖² is below 0.05² times the variance of q.
    """
    pairs = Counter(
        (piece.run, item.run) for piece in pieces for item in training if _is_in(piece, item)
    )
    title = f"motions of the {name} that repeat one of the training"
    results = []
    for (run, original), count in pairs.items():
        text = (
            f"{name}: {count} of the motions of {run} repeat one of {original}, which is in the "
            "training: keep such runs in one split"
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
