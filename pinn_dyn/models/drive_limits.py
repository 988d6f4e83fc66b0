"""Limits of the torque of a drive: current, and voltage by a torque-speed curve."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor, nn

from pinn_dyn.mechanics.arrays import listed
from pinn_dyn.models.known_constants import HasConstants
from pinn_dyn.models.scales import Scales

_SHARPNESS = 16  # the torque is 0.96 of its limit where the command reaches the limit
_BEYOND = 100.0  # ratio to the limit beyond which the torque is constant
_LINEAR = 0.8  # ratio below which the torque equals the command to 0.2 %
_REACHABLE = 0.98  # part of the limit that a command can reach
_SMALLEST = 1e-3  # limit beyond the no-load speed, in units of the limit at rest

Limit = PositiveFloat | Sequence[PositiveFloat] | Literal["learned"] | None


class DriveLimits(HasConstants):
    """Torque tau of a drive, such as a DC motor, with the commanded torque s::

        l(w) = min(L, S (1 - w / w_0)),    -l(-v) <= tau <= l(v)
        tau = c + h x / (1 + |x|^16)^(1/16),    x = (s - c) / h,    c, h = (l(v) -+ l(-v)) / 2

    L is the torque at the largest current; S is the stall torque and w_0 the no-load speed at the
    largest voltage. While braking, only the current limits the torque. Beyond w_0, l is 0.001 of
    its value at rest. Symbols: L and S ``(n,)`` in Nm or N, w_0 in rad/s or m/s, s, tau and v
    ``(*batch, n)``, all at the joint. Assumptions: a stiff gear, constant voltage and temperature.
    Source: Spong, Hutchinson, Vidyasagar 2006, Robot Modeling and Control, sec. 6.2.

    Args:
        scales: scales of the n driven joints. The value is the typical torque, ``(n,)``.
        limit: L, one number or n; ``"learned"``; or None for no limit of the current.
        stall: S, like ``limit``; needs ``no_load_speed``.
        no_load_speed: w_0, like ``limit``; needs ``stall``.
        spread: prior standard deviation of the logarithm of learned limits.

    Raises:
        ValueError: if all limits are None, or only one of ``stall`` and ``no_load_speed`` is set.
    """

    def __init__(
        self,
        scales: Scales,
        *,
        limit: Limit = None,
        stall: Limit = None,
        no_load_speed: Limit = None,
        spread: NonNegativeFloat = 1.0,
    ):
        super().__init__()
        limit, stall, no_load_speed = map(listed, (limit, stall, no_load_speed))
        if (stall is None) != (no_load_speed is None) or (limit is None and stall is None):
            raise ValueError(
                f"limits has limit {limit}, stall {stall} and no_load_speed {no_load_speed}, "
                "expected a limit, or stall and no_load_speed together, or all three"
            )
        unlimited = torch.finfo(torch.float32).max
        speed = torch.full_like(scales.value, float(scales.statistics.v_std.mean()))
        self.learned = nn.ModuleDict()
        for name, label, value, typical, quantity in (
            ("limit", "torque limit", limit, scales.value, "force"),
            ("stall", "stall torque", stall, 2 * scales.value, "force"),
            ("speed", "no-load speed", no_load_speed, 3 * speed, "speed"),
        ):
            if value == "learned":
                self.learned[name] = scales.positive(label, 1.0, typical, spread or 1.0, quantity)
                value = None
            number = torch.as_tensor(unlimited if value is None else value, dtype=torch.float32)
            self.register_buffer(f"fixed_{name}", number.expand(len(scales.joints)).clone())

    def forward(self, force: Tensor, v: Tensor) -> Tensor:
        """Return tau, ``(*batch, n)``, for the commanded force s at the velocity v."""
        center, half = self._range(v)
        ratio = ((force - center) / half).clamp(-_BEYOND, _BEYOND)
        return center + half * ratio / (1 + ratio**_SHARPNESS) ** (1 / _SHARPNESS)

    def saturated(self, force: Tensor, v: Tensor) -> Tensor:
        """Return true where the torque deviates from the command, ``(*batch, n)``, bool."""
        center, half = self._range(v)
        return (force - center).abs() > _LINEAR * half

    def reachable(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Return the smallest and the largest force that a command can reach, ``(*batch, n)``."""
        center, half = self._range(v)
        return center - _REACHABLE * half, center + _REACHABLE * half

    def at_rest(self) -> Tensor:
        """Return the largest torque at rest, min(L, S), ``(n,)``."""
        return torch.minimum(self._value("limit"), self._value("stall"))

    def _value(self, name: str) -> Tensor:
        return self.learned[name]() if name in self.learned else self.get_buffer(f"fixed_{name}")

    def _range(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Return c and h, ``(*batch, n)``."""
        limit, stall = self.at_rest(), self._value("stall")
        drop = stall / self._value("speed") * v
        forward = torch.minimum(limit, stall - drop).clamp_min(0.0)
        backward = torch.minimum(limit, stall + drop).clamp_min(0.0)
        return (forward - backward) / 2, (forward + backward) / 2 + _SMALLEST * limit
