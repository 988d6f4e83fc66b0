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
    """

    q_low: Sequence[float]
    q_high: Sequence[float]
    v_max: Sequence[NonNegativeFloat]

    def __post_init__(self) -> None:
        if (np.subtract(self.q_high, self.q_low) < 0).any():
            raise ValueError(f"q_low = {self.q_low} exceeds q_high = {self.q_high}")

    def draw(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw ``count`` initial configurations and velocities, both ``(count, N)``."""
        v_max = np.asarray(self.v_max, dtype=float)
        shape = (count, len(v_max))
        return rng.uniform(self.q_low, self.q_high, shape), rng.uniform(-v_max, v_max, shape)
