"""Where simulated motions start, and the limits that they stay within."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class InitialStates:
    """A box from which initial states are drawn uniformly.

    Args:
        q_low, q_high: bounds of the configuration, ``(N,)``.
        v_max: bound of the speed of each coordinate, ``(N,)``.

    Raises:
        ValueError: if the lengths differ, a bound is not finite, or a lower one exceeds the upper.
    """

    q_low: Sequence[float]
    q_high: Sequence[float]
    v_max: Sequence[float]

    def __post_init__(self) -> None:
        if not len(self.q_low) == len(self.q_high) == len(self.v_max):
            raise ValueError(
                f"InitialStates: q_low, q_high and v_max have {len(self.q_low)}, "
                f"{len(self.q_high)} and {len(self.v_max)} entries, expected the same number"
            )
        bounds = np.array([self.q_low, self.q_high, self.v_max], dtype=float)
        if not np.isfinite(bounds).all():
            raise ValueError(
                f"InitialStates: bounds are {bounds.tolist()}, expected finite numbers"
            )
        if (bounds[0] > bounds[1]).any() or (bounds[2] < 0).any():
            raise ValueError(
                f"InitialStates: q_low = {list(self.q_low)}, q_high = {list(self.q_high)}, v_max = "
                f"{list(self.v_max)}: expected q_low <= q_high and v_max >= 0"
            )

    def draw(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """``count`` initial configurations and velocities, both ``(count, N)``."""
        v_max = np.asarray(self.v_max, dtype=float)
        shape = (count, len(v_max))
        return rng.uniform(self.q_low, self.q_high, shape), rng.uniform(-v_max, v_max, shape)


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
