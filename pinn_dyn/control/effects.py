"""What stands between a control law and its plant: actuator limits, sensor noise, dead time."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

_Values = float | Sequence[float] | None


@dataclass
class Actuator:
    """Limits of the input and of its rate::

        low <= u <= high,    |u(t_k) - u(t_k-1)| <= rate (t_k - t_k-1)

    Before the first instant the input was zero, so the rate limits the first one too; where a
    range excludes what the rate allows, the range wins.

    Args:
        low: lower limit, one number or M, in the units of u; None for no limit.
        high: upper limit, likewise.
        rate: largest rate of change, one number or M, in the units of u per s; likewise.

    Raises:
        ValueError: on NaN, low above high, or a rate that is not positive.
    """

    low: _Values = None
    high: _Values = None
    rate: _Values = None
    _previous: Tensor | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        low, high = self._bounds()
        for name, values in (("low", low), ("high", high)):
            if np.isnan(values).any():
                raise ValueError(f"Actuator: {name} is {getattr(self, name)}, expected numbers")
        if low.ndim and high.ndim and low.shape != high.shape:
            raise ValueError(
                f"Actuator: low has {low.size} entries and high {high.size}, expected as many"
            )
        if (low > high).any():
            raise ValueError(f"Actuator: low is {self.low} and high {self.high}: low exceeds high")
        if self.rate is not None and not (np.asarray(self.rate, dtype=float) > 0).all():
            raise ValueError(f"Actuator: rate is {self.rate}, expected positive numbers")

    def reset(self) -> None:
        """Back to an input of zero, before a new run."""
        self._previous = None

    def limit(self, u: Tensor) -> Tensor:
        """u within [low, high], ``(*batch, M)``, whatever came before; NaN stays NaN."""
        low, high = (_per_entry("Actuator: limits", values, u) for values in self._bounds())
        return torch.minimum(torch.maximum(u, low), high)

    def __call__(self, u: Tensor, interval: float) -> tuple[Tensor, Tensor]:
        """The input that gets through, and a mask of the entries that were changed.

        Args:
            u: input asked for, ``(*batch, M)``.
            interval: time since the call before, s.
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

    Raises:
        ValueError: on a standard deviation that is negative or not finite.
    """

    q_noise: float | Sequence[float] = 0.0
    v_noise: float | Sequence[float] = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("q_noise", "v_noise"):
            values = np.asarray(getattr(self, name), dtype=float)
            if not (np.isfinite(values).all() and (values >= 0).all()):
                raise ValueError(
                    f"Sensor: {name} is {getattr(self, name)}, expected standard deviations of at "
                    "least 0"
                )
        self.reset()

    def reset(self) -> None:
        """Start the noise from its seed again."""
        self._generator = torch.Generator().manual_seed(self.seed)

    def __call__(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Measured q and v, ``(*batch, N)`` each, from the true ones."""
        return self._measured("q_noise", q), self._measured("v_noise", v)

    def _measured(self, name: str, value: Tensor) -> Tensor:
        deviation = np.asarray(getattr(self, name), dtype=float)
        noise = torch.randn(value.shape, generator=self._generator, dtype=value.dtype)
        return value + _per_entry(f"Sensor: {name}", deviation, value) * noise.to(value)


@dataclass
class Delay:
    """A dead time: the input of ``samples`` instants ago, and zero before there was any.

    Args:
        samples: dead time in control instants, at least 0.

    Raises:
        ValueError: on a number of samples that is negative or not whole.
    """

    samples: int

    def __post_init__(self) -> None:
        if not (self.samples >= 0 and self.samples == int(self.samples)):
            raise ValueError(f"Delay: samples is {self.samples}, expected a whole number from 0")
        self.reset()

    def reset(self) -> None:
        """Forget the inputs on their way."""
        self._queue: deque[Tensor] = deque()

    def __call__(self, u: Tensor) -> Tensor:
        """The input that arrives now, ``(*batch, M)``, as ``u`` sets out."""
        self._queue.append(u)
        if len(self._queue) <= self.samples:
            return torch.zeros_like(u)
        return self._queue.popleft()


def _per_entry(what: str, values: np.ndarray, like: Tensor) -> Tensor:
    """One number, or one for each entry of the last dimension, as a tensor like another."""
    if values.ndim and values.shape != like.shape[-1:]:
        raise ValueError(
            f"{what} have {values.size} entries, expected one number or {like.shape[-1]}"
        )
    return torch.from_numpy(values).to(like)
