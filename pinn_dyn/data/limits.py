"""Limits of the configuration that simulated motions stay within."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


class Limits:
    """A box of configurations, q_low <= q <= q_high.

    Args:
        name: name of the limits, for messages.
        bounds: q_low and q_high, ``(2, N)``.
        around: a second box that must lie inside.

    Raises:
        ValueError: on another size, or if the second box does not lie inside.
    """

    def __init__(
        self,
        name: str,
        bounds: Sequence[Sequence[float]],
        *,
        around: tuple[Sequence[float], Sequence[float]],
    ):
        self.bounds = np.asarray(bounds, dtype=float)
        if self.bounds.shape != (2, len(around[0])):
            raise ValueError(
                f"{name} is {self.bounds.tolist()}, expected [low, high] of "
                f"{len(around[0])} numbers"
            )
        low, high = self.bounds
        if not ((low <= around[0]) & (around[1] <= high)).all():
            raise ValueError(
                f"{name} is {self.bounds.tolist()}, expected to hold the initial states, from "
                f"{list(around[0])} to {list(around[1])}"
            )

    def left_by(self, q: np.ndarray) -> np.ndarray:
        """Return a mask of the K motions ``(K, T, N)`` that leave the limits, ``(K,)``."""
        low, high = self.bounds
        return ~((q >= low) & (q <= high)).all((1, 2))

    def passed(self, q: np.ndarray, labels: Sequence[str]) -> str:
        """Describe the limits that K motions ``(K, T, N)`` pass, with the number of motions."""
        lowest, highest = np.nanmin(q, axis=1), np.nanmax(q, axis=1)
        parts = []
        for k, label in enumerate(labels):
            low, high = self.bounds[:, k]
            for side, bound, beyond in (
                ("below", low, lowest[:, k] < low),
                ("above", high, highest[:, k] > high),
            ):
                if beyond.any():
                    parts.append(f"{label} {side} {bound:g} ({beyond.sum()} motions)")
        return ", ".join(parts)
