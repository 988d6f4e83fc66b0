"""Actuator limits and sensor noise between a control law and its plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat
from torch import Tensor

Values = float | Sequence[float] | Tensor
"""One number for all inputs, or M of them."""
_Deviation = NonNegativeFloat | Sequence[NonNegativeFloat]


@dataclass
class Actuator:
    """Limits of the input and of its rate::

        low <= u <= high,    |u(t_k) - u(t_k-1)| <= rate (t_k - t_k-1)

    If both limits cannot hold, the input obeys ``low`` and ``high``.

    Args:
        low, high: limits in the units of u, one number or M; None for no limit.
        rate: largest rate of change in the units of u per s, one number or M; None for no limit.

    Raises:
        ValueError: if low exceeds high, or a limit is NaN.
    """

    low: Values | None = None
    high: Values | None = None
    rate: PositiveFloat | Sequence[PositiveFloat] | Tensor | None = None

    def __post_init__(self) -> None:
        low = -np.inf if self.low is None else np.asarray(self.low)
        if not np.all(low <= (np.inf if self.high is None else np.asarray(self.high))):
            raise ValueError(f"Actuator: low {self.low} and high {self.high}, expected low <= high")

    def limit(self, u: Tensor, previous: Tensor | None = None, period: float = 0.0) -> Tensor:
        """Limit u ``(*batch, M)``, which follows ``previous`` after a period in s; NaN stays NaN.

        Without ``previous``, the rate is not limited.
        """
        if self.rate is not None and previous is not None:
            change = period * _like(self.rate, u)
            u = u.clamp(previous - change, previous + change)
        low = -torch.inf if self.low is None else self.low
        high = torch.inf if self.high is None else self.high
        return u.clamp(_like(low, u), _like(high, u))


@dataclass
class Sensor:
    """Measurements with white Gaussian noise, drawn anew at each call and for each copy.

    Args:
        q_noise: standard deviation of the noise on q, one number or N, in the units of q.
        v_noise: standard deviation of the noise on v, one number or N, in the units of v.
        seed: seed of the noise; a reset repeats the noise.
    """

    q_noise: _Deviation = 0.0
    v_noise: _Deviation = 0.0
    seed: NonNegativeInt = 0

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Restart the noise from its seed."""
        self._generator = torch.Generator().manual_seed(self.seed)

    def __call__(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Return the measured q and v, ``(*batch, N)`` each."""
        return self._measured(q, self.q_noise), self._measured(v, self.v_noise)

    def _measured(self, value: Tensor, deviation: _Deviation) -> Tensor:
        noise = torch.randn(value.shape, generator=self._generator, dtype=value.dtype)
        return value + _like(deviation, value) * noise.to(value)


def _like(value: Values, tensor: Tensor) -> Tensor:
    return torch.as_tensor(value, dtype=tensor.dtype, device=tensor.device)
