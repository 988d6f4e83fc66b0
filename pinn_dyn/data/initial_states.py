"""Initial states of simulated motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import NonNegativeFloat


@dataclass(frozen=True)
class InitialStates:
    """A box from which initial states are drawn uniformly.

    Args:
        q_low, q_high: bounds of the configuration, ``(N,)``.
        v_max: bound of the speed of each coordinate, ``(N,)``.

    Raises:
        ValueError: if the lengths differ, or a lower bound exceeds the upper bound.
    """

    q_low: Sequence[float]
    q_high: Sequence[float]
    v_max: Sequence[NonNegativeFloat]

    def __post_init__(self) -> None:
        if not len(self.q_low) == len(self.q_high) == len(self.v_max):
            raise ValueError(
                f"InitialStates: q_low, q_high and v_max have {len(self.q_low)}, "
                f"{len(self.q_high)} and {len(self.v_max)} entries, expected the same number"
            )
        if any(low > high for low, high in zip(self.q_low, self.q_high, strict=True)):
            raise ValueError(
                f"InitialStates: q_low = {list(self.q_low)}, q_high = {list(self.q_high)}, "
                "expected q_low <= q_high"
            )

    def draw(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw ``count`` initial configurations and velocities, both ``(count, N)``."""
        v_max = np.asarray(self.v_max, dtype=float)
        shape = (count, len(v_max))
        return rng.uniform(self.q_low, self.q_high, shape), rng.uniform(-v_max, v_max, shape)
