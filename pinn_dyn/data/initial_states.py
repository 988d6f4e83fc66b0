"""Where simulated motions start."""

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
