"""Actuator limits, sensor noise and dead time between a control law and its plant."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat
from torch import Tensor

_Values = float | Sequence[float] | None
_Deviation = NonNegativeFloat | Sequence[NonNegativeFloat]


@dataclass
class Actuator:
    """Limits of the input and of its rate::

        low <= u <= high,    |u(t_k) - u(t_k-1)| <= rate (t_k - t_k-1)

    The input is zero before the first instant, so the rate limits the first input too. Where the
    range excludes all inputs that the rate allows, the range wins.

    Args:
        low: lower limit, one number or M, in the units of u; None for no limit.
        high: upper limit, likewise.
        rate: largest rate of change, one number or M, in the units of u per s; likewise.

    Raises:
        ValueError: if low exceeds high.
    """

    low: _Values = None
    high: _Values = None
    rate: PositiveFloat | Sequence[PositiveFloat] | None = None
    _previous: Tensor | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        low, high = self._bounds()
        if (low > high).any():
            raise ValueError(f"Actuator: low is {self.low} and high {self.high}: low exceeds high")

    def reset(self) -> None:
        """Return to an input of zero, before a new run."""
        self._previous = None

    def limit(self, u: Tensor) -> Tensor:
        """Clip u ``(*batch, M)`` to [low, high]; NaN stays NaN."""
        low, high = (_per_entry("Actuator: limits", values, u) for values in self._bounds())
        return torch.minimum(torch.maximum(u, low), high)

    def __call__(self, u: Tensor, interval: float) -> tuple[Tensor, Tensor]:
        """Return the input that passes the limits, and a mask of the entries that were changed.

        Args:
            u: input of the law, ``(*batch, M)``.
            interval: time since the previous call, s.
        """
        applied = u
        if self.rate is not None:
            change = interval * _per_entry("Actuator: rate", np.asarray(self.rate, dtype=float), u)
            previous = torch.zeros_like(u) if self._previous is None else self._previous
            applied = torch.minimum(torch.maximum(u, previous - change), previous + change)
        applied = self.limit(applied)
        self._previous = applied
        return applied, applied != u

    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        low = -np.inf if self.low is None else self.low
        high = np.inf if self.high is None else self.high
        return np.asarray(low, dtype=float), np.asarray(high, dtype=float)


@dataclass
class Sensor:
    """Measurements with white Gaussian noise, drawn anew at each call and for each copy.

    Args:
        q_noise: standard deviation of the noise on q, one number or N, in the units of q.
        v_noise: standard deviation of the noise on v, likewise.
        seed: seed of the noise; the same one gives the same noise after each reset.

    """

    q_noise: _Deviation = 0.0
    v_noise: _Deviation = 0.0
    seed: NonNegativeInt = 0

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Start the noise from its seed again."""
        self._generator = torch.Generator().manual_seed(self.seed)

    def __call__(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Return the measured q and v, ``(*batch, N)`` each."""
        return self._measured("q_noise", q), self._measured("v_noise", v)

    def _measured(self, name: str, value: Tensor) -> Tensor:
        deviation = np.asarray(getattr(self, name), dtype=float)
        noise = torch.randn(value.shape, generator=self._generator, dtype=value.dtype)
        return value + _per_entry(f"Sensor: {name}", deviation, value) * noise.to(value)


@dataclass
class Delay:
    """A dead time: the input of ``samples`` instants before, zero at the beginning.

    Args:
        samples: dead time in control instants, at least 0.

    """

    samples: NonNegativeInt

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the inputs that have not arrived."""
        self._queue: deque[Tensor] = deque()

    def __call__(self, u: Tensor) -> Tensor:
        """Return the input that arrives at the instant when ``u`` is sent, ``(*batch, M)``."""
        self._queue.append(u)
        if len(self._queue) <= self.samples:
            return torch.zeros_like(u)
        return self._queue.popleft()


def _per_entry(what: str, values: np.ndarray, like: Tensor) -> Tensor:
    """Convert one number, or one for each entry of the last dimension, to a tensor."""
    if values.ndim and values.shape != like.shape[-1:]:
        raise ValueError(
            f"{what} have {values.size} entries, expected one number or {like.shape[-1]}"
        )
    return torch.from_numpy(values).to(like)
