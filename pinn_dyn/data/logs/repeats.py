"""Motions that come twice: copies of runs, and tests that repeat what was trained on."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator

import numpy as np
from scipy.signal import fftconvolve

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording, Report

# A motion within this share of its spread of another one repeats it.
_SAME = 0.05
# Samples of a motion that are compared.
_SAMPLES = 300


def check_copies(parts: dict[str, list[Recording]], report: Report) -> None:
    """Warns of stretches with the same numbers in one split.

    Raises:
        LogError: where they are in two splits, as the test would be of what was trained on.
    """
    first: dict[bytes, tuple[str, Recording]] = {}
    for split, recordings in parts.items():
        for item in recordings:
            content = b"".join(
                hashlib.blake2b(np.ascontiguousarray(x).data).digest() for x in (item.q, item.u)
            )
            if content not in first:
                first[content] = split, item
                continue
            other_split, other = first[content]
            if other_split != split:
                raise LogError(
                    f"{item.run}, in {split}, is a copy of {other.run}, in {other_split}, number "
                    "by number: leave one of them out, or put both into one split"
                )
            report.warn(f"{item.run} is a copy of {other.run}, number by number (both {split})")


def check_repeats(
    training: list[Recording], test: list[Recording], name: str, report: Report
) -> None:
    """Warns where a roll-out of the test repeats a motion of the training.

    It does where, at some shift s along a training stretch, the mean over its samples of
    ‖q_test(t) - q_train(t + s)‖² is below 0.05² times the variance of q_test, all at one rate.

    Args:
        training: training stretches.
        test: the roll-outs.
        name: of their split.
        report: takes the warnings.
    """
    found = Counter((piece.run, item.run) for piece, item, _ in _repeats(test, training))
    for (run, other), pieces in found.items():
        report.warn(
            f"{name}: {pieces} of the motions of {run} repeat one of {other}, which is in the "
            "training: errors on them say little of new motions; keep such runs in one split"
        )


def repeat_floor(
    pieces: list[Recording], training: list[Recording]
) -> tuple[int, np.ndarray, np.ndarray]:
    """What motions that come twice differ by: noise, and all that is not the same in both.

    The difference of a piece and of the stretch of the training that it repeats, at the nearest
    shift, freed of the rest of a sample's shift (the part of it along v), is √2 times the floor.

    Args:
        pieces: motions that may repeat one of the training, with q and v.
        training: stretches, with q and v; a piece is not compared with the stretch it is from.

    Returns:
        The number of repeats, and the floors of q and of v, ``(N,)`` each, NaN without a repeat.
    """
    squares = []
    for piece, item, firsts in _repeats(pieces, training):
        parts = [item.rows(slice(first, first + len(piece))) for first in firsts]
        other = min(parts, key=lambda part: float(((part.q - piece.q) ** 2).sum()))
        assert piece.v is not None
        assert other.v is not None
        dq, dv = piece.q - other.q, piece.v - other.v
        shift = float((dq * other.v).sum() / max((other.v**2).sum(), 1e-300))
        dq = dq - shift * other.v
        if dq.any():  # a copy of a file tells nothing
            squares.append([(x**2).mean(axis=0) for x in (dq, dv)])
    if not squares:
        none = np.full(training[0].q.shape[1], np.nan)
        return 0, none, none
    q, v = np.sqrt(np.mean(squares, axis=0) / 2)
    return len(squares), q, v


def _repeats(
    pieces: list[Recording], training: list[Recording]
) -> Iterator[tuple[Recording, Recording, range]]:
    """Each piece with each stretch that it repeats, and the samples where that may begin."""
    for piece in pieces:
        thin = max(1, len(piece) // _SAMPLES)
        q = piece.q[::thin]
        spread = float(q.var(axis=0).sum())
        for item in training:
            cut_out = piece.run == item.run and item.t[0] <= piece.t[0] <= item.t[-1]
            if spread == 0 or cut_out or len(item) < len(piece):
                continue
            distance, near = _nearest(q, item.q, thin)
            if distance < _SAME**2 * spread:
                last = min(near + thin, len(item) - len(piece))
                yield piece, item, range(max(near - thin, 0), last + 1)


def _nearest(q: np.ndarray, track: np.ndarray, thin: int) -> tuple[float, int]:
    """Smallest mean square distance of q ``(T, N)`` from every ``thin``-th sample of a track.

    Also the sample of the track where the nearest stretch begins.
    """
    best, where = np.inf, 0
    centre = q.mean(axis=0)
    q = q - centre
    for start in range(0, thin, max(1, thin // 4)):
        other = track[start::thin] - centre
        if len(other) >= len(q):
            squares = np.cumsum(np.r_[0.0, (other**2).sum(axis=1)])
            energy = squares[len(q) :] - squares[: -len(q)]
            products = (
                fftconvolve(a, b[::-1], mode="valid") for a, b in zip(other.T, q.T, strict=True)
            )
            distances = (energy - 2 * sum(products) + (q**2).sum()) / len(q)
            k = int(distances.argmin())
            if distances[k] < best:
                best, where = float(distances[k]), start + k * thin
    return best, where
