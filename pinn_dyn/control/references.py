"""Desired motions in joint space: set points, moves from point to point, sines."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from pinn_dyn.control.contracts import Motion, Reference

Vector = Sequence[float] | np.ndarray | Tensor
Configurations = Sequence[float] | Sequence[Sequence[float]] | Tensor

# Samples of a check: one per millisecond, fewer if the motion is long.
_CHECK_STEP, _MAX_CHECKS = 1e-3, 10_000


class SetPoint(Reference):
    """A configuration to hold: q_ref(t) = q, v_ref = a_ref = 0.

    Args:
        q: ``(N,)``, or ``(K, N)`` for K runs, rad (m for a length).

    Raises:
        ValueError: if q is missing.
    """

    def __init__(self, q: Configurations | None = None):
        if q is None:
            raise ValueError("no set point for the closed loop: give it as reference.q=[...]")
        self.q = _tensor(q)
        self.num_coordinates = self.q.shape[-1]
        self._zero = torch.zeros_like(self.q)

    def __call__(self, t: float) -> Motion:
        return Motion(self.q, self._zero, self._zero)


class RandomSetPoints(SetPoint):
    """K configurations to hold, drawn uniformly and independently from a box, q ``(K, N)``.

    Args:
        q_low, q_high: the box, ``(N,)``, rad.
        count: K.
        seed: seed of the draw.
    """

    def __init__(self, q_low: Vector, q_high: Vector, count: PositiveInt, seed: NonNegativeInt):
        low, high = torch.stack([_tensor(q_low), _tensor(q_high)])
        draw = np.random.default_rng(seed).uniform(size=(count, len(low)))
        super().__init__(low + torch.from_numpy(draw) * (high - low))


class PointToPoint(Reference):
    """A straight move in joint space from rest to rest by a quintic, followed by a hold::

        q_ref(t) = q_start + s(x) (q_end - q_start),  s = 10 x^3 - 15 x^4 + 6 x^5,
        x = (t - begin) / duration, clipped to [0, 1]

    The largest speed is 15/8 |q_end - q_start| / duration.

    Source: Siciliano et al. 2009, Robotics: Modelling, Planning and Control, sec. 4.2.

    Args:
        q_start, q_end: ``(N,)``, or ``(K, N)`` for K runs, rad.
        duration: duration of the move, s.
        begin: time at which the move begins, s; q_start is held until then.
    """

    def __init__(
        self,
        q_start: Configurations,
        q_end: Configurations,
        duration: PositiveFloat,
        begin: NonNegativeFloat = 0.0,
    ):
        start, end = _tensor(q_start), _tensor(q_end)
        self.num_coordinates = start.shape[-1]
        self._start, self._change = torch.broadcast_tensors(start, end - start)
        self.duration, self.begin = float(duration), float(begin)

    def __call__(self, t: float) -> Motion:
        s, rate, rate2 = smooth_step((t - self.begin) / self.duration)
        return Motion(
            self._start + s * self._change,
            rate / self.duration * self._change,
            rate2 / self.duration**2 * self._change,
        )


class Sines(Reference):
    """One sine in each joint, with a smooth start::

        q_ref,i(t) = c_i + w(t) a_i sin(2 pi f_i t + phi_i)

    The weight w rises from 0 to 1 within ``rise_time`` by the quintic of :class:`PointToPoint`. The
    motion then starts at rest at c. With rise_time = 0, w = 1.

    Args:
        centre: c, ``(N,)``, or ``(K, N)`` for K runs, rad.
        amplitude: a, one number or N, rad.
        frequency: f, one number or N, Hz, at least 0.
        phase: phi, one number or N, rad.
        rise_time: duration of the smooth start, s.
    """

    def __init__(
        self,
        centre: Configurations,
        amplitude: float | Sequence[float],
        frequency: NonNegativeFloat | Sequence[NonNegativeFloat],
        phase: float | Sequence[float] = 0.0,
        rise_time: NonNegativeFloat = 0.0,
    ):
        self._centre = _tensor(centre)
        self.num_coordinates = self._centre.shape[-1]
        self._amplitude, self._phase = _tensor(amplitude), _tensor(phase)
        self._omega = 2 * math.pi * _tensor(frequency)
        self.rise_time = float(rise_time)

    def __call__(self, t: float) -> Motion:
        w, rate, rate2 = smooth_step(t / self.rise_time) if self.rise_time else (1.0, 0.0, 0.0)
        rise_time = self.rise_time or 1.0
        rate, rate2 = rate / rise_time, rate2 / rise_time**2
        angle = self._omega * t + self._phase
        sine, cosine = torch.sin(angle), torch.cos(angle)
        wave = self._amplitude * sine
        wave1 = self._amplitude * self._omega * cosine
        wave2 = -(self._omega**2) * wave
        return Motion(
            self._centre + w * wave,
            (rate * wave + w * wave1).expand_as(self._centre),
            (rate2 * wave + 2 * rate * wave1 + w * wave2).expand_as(self._centre),
        )


def check_limits(
    reference: Reference,
    q_low: Vector,
    q_high: Vector,
    duration: float,
    v_max: Vector | None = None,
) -> None:
    """Check at up to 10,000 times that a reference stays within the limits of a robot.

    Args:
        reference: the desired motion.
        q_low, q_high: limits of the configuration, ``(N,)``, rad.
        duration: duration of the motion, s.
        v_max: limits of the speed, ``(N,)``, rad/s; 0 or None for no limit.

    Raises:
        ValueError: if the reference leaves the limits. The message names the time and the joint.
    """
    speed = torch.zeros(reference.num_coordinates) if v_max is None else _tensor(v_max)
    speed = torch.where(speed == 0, torch.inf, speed)
    count = min(math.ceil(duration / _CHECK_STEP), _MAX_CHECKS) + 1
    for t in np.linspace(0.0, duration, count).tolist():
        motion = reference(t)
        _require_within("q", motion.q, _tensor(q_low), _tensor(q_high), t)
        _require_within("v", motion.v, -speed, speed, t)


def smooth_step(x: float) -> tuple[float, float, float]:
    """Return s = 10 x^3 - 15 x^4 + 6 x^5, ds/dx and d^2s/dx^2 with x clipped to [0, 1]."""
    x = min(max(x, 0.0), 1.0)
    return (
        x**3 * (10 - 15 * x + 6 * x**2),
        30 * x**2 * (1 - x) ** 2,
        60 * x * (1 - x) * (1 - 2 * x),
    )


def _require_within(name: str, value: Tensor, low: Tensor, high: Tensor, t: float) -> None:
    # Not "value > high": a NaN is outside too. The slack is for rounding at a limit itself.
    outside = ~((value >= low - 1e-9) & (value <= high + 1e-9))
    if outside.any():
        *copy, i = (int(k) for k in outside.nonzero()[0])
        run = f" of run {copy[0]}" if copy else ""
        raise ValueError(
            f"the reference leaves the limits at t = {t:.4g} s: {name}[{i}]{run} is "
            f"{float(value[(*copy, i)]):.4g}, expected {float(low[i]):.4g} to {float(high[i]):.4g}"
        )


def _tensor(value: float | Configurations | Vector) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64).detach().clone()
