"""Limits of the configuration that simulated motions stay within."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


class Limits:
    """A box of configurations, q_low <= q <= q_high.

    Args:
        name: what is limited, for messages.
        bounds: q_low and q_high, ``(2, N)``.
        around: another such box that it has to hold.

    Raises:
        ValueError: on other sizes or bounds that are not finite, or if the other box is not inside.
    """

    def __init__(
        self,
        name: str,
        bounds: Sequence[Sequence[float]],
        *,
        around: tuple[Sequence[float], Sequence[float]],
    ):
        shown = [list(row) for row in bounds]
        size = len(around[0])
        if [len(row) for row in shown] != [size, size] or not np.isfinite(shown).all():
            raise ValueError(
                f"{name} is {shown}, expected [low, high] with {size} finite numbers each"
            )
        self.bounds = np.asarray(shown, dtype=float)
        low, high = self.bounds
        if not ((low <= around[0]) & (around[1] <= high)).all():
            raise ValueError(
                f"{name} is {shown}, expected to hold the initial states, from {list(around[0])} "
                f"to {list(around[1])}"
            )

    def left_by(self, q: np.ndarray) -> np.ndarray:
        """Which of K motions ``(K, T, N)`` leave the limits; samples after that may be NaN."""
        low, high = self.bounds
        return ~((q >= low) & (q <= high)).all((1, 2))

    def passed(self, q: np.ndarray, labels: Sequence[str]) -> str:
        """Which limits are passed by how many of K motions ``(K, T, N)``."""
        lowest, highest = np.nanmin(q, axis=1), np.nanmax(q, axis=1)
        found = []
        for k, label in enumerate(labels):
            low, high = self.bounds[:, k]
            for side, bound, beyond in (
                ("below", low, lowest[:, k] < low),
                ("above", high, highest[:, k] > high),
            ):
                if beyond.any():
                    found.append(f"{label} {side} {bound:g} ({beyond.sum()} motions)")
        return ", ".join(found)
