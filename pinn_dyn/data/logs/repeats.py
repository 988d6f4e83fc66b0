"""Motions that occur twice: copies of runs, and test motions that repeat a training motion."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping

import numpy as np
from scipy.signal import fftconvolve

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.data.logs.recording import Recording

# A motion within this share of its spread of another motion repeats it.
_SAME = 0.05
# Number of samples of a motion that are compared.
_SAMPLES = 300


def check_copies(parts: Mapping[str, list[Recording]]) -> list[Measurement]:
    """Warn of stretches with the same numbers in one split.

    Raises:
        LogError: if they are in two splits: the test would measure training motions.
    """
    first: dict[bytes, tuple[str, Recording]] = {}
    results = []
    for split, recordings in parts.items():
        for item in recordings:
            content = b"".join(
                hashlib.blake2b(np.ascontiguousarray(x).data).digest() for x in (item.q, item.u)
            )
            first_split, original = first.setdefault(content, (split, item))
            if first_split != split:
                raise LogError(
                    f"{item.run}, in {split}, is a copy of {original.run}, in {first_split}, "
                    "number by number: leave one of them out, or put both into one split"
                )
            if original is not item:
                text = f"{item.run} is a copy of {original.run}, number by number (both {split})"
                results.append(judged("copy of a run", item.run, 1, "0", True, text))
    return results


def check_repeats(
    training: list[Recording], pieces: list[Recording], name: str
) -> list[Measurement]:
    """Count the roll-outs of a split that repeat a motion of the training.

    A roll-out repeats a training stretch if, at a shift s along it, the mean over its samples of
    ‖q_test(t) - q_train(t + s)‖² is below 0.05² times the variance of q_test, all at one rate.

    Args:
        training: training stretches.
        pieces: the roll-outs.
        name: name of their split.
    """
    pairs = Counter((piece.run, item.run) for piece, item in _repeats(pieces, training))
    title = f"motions of the {name} that repeat one of the training"
    results = [
        judged(
            title,
            run,
            count,
            "0",
            True,
            f"{name}: {count} of the motions of {run} repeat one of {original}, which is in the "
            "training: errors on them say little of new motions; keep such runs in one split",
            section="csv_logs.md#splits",
        )
        for (run, original), count in pairs.items()
    ]
    return results or [judged(title, name, 0, "0", False, "")]


def _repeats(
    pieces: list[Recording], training: list[Recording]
) -> Iterator[tuple[Recording, Recording]]:
    """Yield each piece with each stretch that it repeats."""
    for piece in pieces:
        thin = max(1, len(piece) // _SAMPLES)
        q = piece.q[::thin]
        spread = float(q.var(axis=0).sum())
        for item in training:
            cut_out = piece.run == item.run and item.t[0] <= piece.t[0] <= item.t[-1]
            if spread == 0 or cut_out or len(item) < len(piece):
                continue
            if _smallest_distance(q, item.q, thin) < _SAME**2 * spread:
                yield piece, item


def _smallest_distance(q: np.ndarray, track: np.ndarray, thin: int) -> float:
    """Return the smallest mean square distance of q ``(T, N)`` from a track, over all shifts.

    Both are compared at every ``thin``-th sample of the track.
    """
    smallest = np.inf
    center = q.mean(axis=0)
    q = q - center
    for start in range(0, thin, max(1, thin // 4)):
        samples = track[start::thin] - center
        if len(samples) >= len(q):
            squares = np.cumsum(np.r_[0.0, (samples**2).sum(axis=1)])
            energy = squares[len(q) :] - squares[: -len(q)]
            products = (
                fftconvolve(a, b[::-1], mode="valid") for a, b in zip(samples.T, q.T, strict=True)
            )
            distances = (energy - 2 * sum(products) + (q**2).sum()) / len(q)
            smallest = min(smallest, float(distances.min()))
    return smallest
