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

# Samples of a check: one each millisecond, fewer if the motion is long.
_CHECK_STEP, _MOST_CHECKS = 1e-3, 10_000


class SetPoint(Reference):
    """A configuration to hold: q_ref(t) = q, v_ref = a_ref = 0.

    Args:
        q: ``(N,)``, or ``(K, N)`` for K runs, rad (m for a length).
    """

    def __init__(self, q: Configurations):
        self.q = _configurations("q", q)
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

    Raises:
        ValueError: on a box whose lower limit lies above the upper one.
    """

    def __init__(self, q_low: Vector, q_high: Vector, count: PositiveInt, seed: NonNegativeInt):
        low, high = _vector("q_low", q_low), _vector("q_high", q_high)
        _require_same_length("q_low", low, "q_high", high)
        if not (low <= high).all():
            i = int((low > high).nonzero()[0])
            raise ValueError(
                f"q_low[{i}] = {low[i]:g} lies above q_high[{i}] = {high[i]:g}: exchange them"
            )
        draw = np.random.default_rng(seed).uniform(size=(count, len(low)))
        super().__init__(low + torch.from_numpy(draw) * (high - low))


class PointToPoint(Reference):
    """A straight move in joint space, from rest to rest by a quintic, then held::

        q_ref(t) = q_start + s(x) (q_end - q_start),  s = 10 x^3 - 15 x^4 + 6 x^5,
        x = (t - begin) / duration, cut to [0, 1]

    Velocity and acceleration are continuous; the largest ones are 15/8 |q_end - q_start|/duration
    and 10/sqrt(3) |q_end - q_start|/duration^2.

    Source: Siciliano et al. 2009, Robotics: Modelling, Planning and Control, sec. 4.2.

    Args:
        q_start, q_end: ``(N,)``, or ``(K, N)`` for K runs, rad.
        duration: duration of the move, s.
        begin: time at which the move begins, s; q_start is held before.

    Raises:
        ValueError: on configurations of different sizes.
    """

    def __init__(
        self,
        q_start: Configurations,
        q_end: Configurations,
        duration: PositiveFloat,
        begin: NonNegativeFloat = 0.0,
    ):
        start, end = _configurations("q_start", q_start), _configurations("q_end", q_end)
        _require_same_length("q_start", start, "q_end", end)
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

    The weight w rises from 0 to 1 within ``rise_time`` by the quintic of :class:`PointToPoint`, so
    the motion starts at rest at c; with rise_time = 0, w = 1 and it starts in full motion.

    Args:
        centre: c, ``(N,)``, or ``(K, N)`` for K runs, rad.
        amplitude: a, one number or N, rad.
        frequency: f, one number or N, Hz, at least 0.
        phase: phi, one number or N, rad.
        rise_time: s.

    Raises:
        ValueError: on numbers of different sizes.
    """

    def __init__(
        self,
        centre: Configurations,
        amplitude: float | Sequence[float],
        frequency: NonNegativeFloat | Sequence[NonNegativeFloat],
        phase: float | Sequence[float] = 0.0,
        rise_time: NonNegativeFloat = 0.0,
    ):
        self._centre = _configurations("centre", centre)
        size = self.num_coordinates = self._centre.shape[-1]
        self._amplitude = _per_joint("amplitude", amplitude, size)
        self._omega = 2 * math.pi * _per_joint("frequency", frequency, size)
        self._phase = _per_joint("phase", phase, size)
        self.rise_time = float(rise_time)

    def __call__(self, t: float) -> Motion:
        w, rate, rate2 = 1.0, 0.0, 0.0
        if self.rise_time:
            w, rate, rate2 = smooth_step(t / self.rise_time)
            rate, rate2 = rate / self.rise_time, rate2 / self.rise_time**2
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
    """Check that a reference stays within the limits of a robot, before anything moves.

    The reference is sampled every millisecond from 0 to ``duration``, at 10,000 times at most.

    Args:
        reference: the desired motion.
        q_low, q_high: limits of the configuration, ``(N,)``, rad; infinite where there is none.
        duration: duration of the motion, s.
        v_max: limits of the speed, ``(N,)``, rad/s; 0 where there is none. None checks no speed.

    Raises:
        ValueError: if the robot has another number of coordinates; or naming the first time
            outside the limits, with joint, value and limits.
    """
    limits = {"q_low": q_low, "q_high": q_high}
    if v_max is not None:
        limits["v_max"] = v_max
    size, bounds = reference.num_coordinates, []
    for name, limit in limits.items():
        bounds.append(torch.as_tensor(limit, dtype=torch.float64))
        if bounds[-1].shape != (size,):
            raise ValueError(
                f"the reference has {size} coordinates, but {name} has the shape "
                f"{tuple(bounds[-1].shape)}: give the reference one for each joint of the robot"
            )
    low, high = bounds[:2]
    speed = bounds[2] if v_max is not None else torch.zeros_like(low)
    speed = torch.where(speed == 0, torch.inf, speed)
    count = min(math.ceil(duration / _CHECK_STEP), _MOST_CHECKS) + 1
    for t in np.linspace(0.0, duration, count).tolist():
        motion = reference(t)
        _require_within("q", motion.q, low, high, t, "rad")
        _require_within("v", motion.v, -speed, speed, t, "rad/s")


def smooth_step(x: float) -> tuple[float, float, float]:
    """Return the quintic from 0 to 1 with zero slope and curvature at both ends, and derivatives.

    s = 10 x^3 - 15 x^4 + 6 x^5, ds/dx and d^2s/dx^2; x is cut to [0, 1].
    """
    x = min(max(x, 0.0), 1.0)
    return (
        x**3 * (10 - 15 * x + 6 * x**2),
        30 * x**2 * (1 - x) ** 2,
        60 * x * (1 - x) * (1 - 2 * x),
    )


def _require_within(
    name: str, value: Tensor, low: Tensor, high: Tensor, t: float, unit: str
) -> None:
    # Not "value > high": a NaN is outside too. The slack is for rounding at a limit itself.
    outside = ~((value >= low - 1e-9) & (value <= high + 1e-9))
    if outside.any():
        *copy, i = (int(k) for k in outside.nonzero()[0])
        of = f" of configuration {copy[0]}" if copy else ""
        raise ValueError(
            f"the reference leaves the limits at t = {t:.4g} s: {name}[{i}]{of} is "
            f"{float(value[(*copy, i)]):.4g} {unit}, allowed are {float(low[i]):.4g} to "
            f"{float(high[i]):.4g} {unit}; make the motion smaller or slower"
        )


def _configurations(name: str, value: Configurations | np.ndarray) -> Tensor:
    """Convert to float64, ``(N,)`` or ``(K, N)``."""
    tensor = torch.as_tensor(value, dtype=torch.float64)
    if tensor.ndim not in (1, 2) or tensor.numel() == 0:
        raise ValueError(
            f"{name} has the shape {tuple(tensor.shape)}, expected (N,) or (K, N) with at least "
            "one number"
        )
    return tensor.detach().clone()


def _vector(name: str, value: Vector) -> Tensor:
    tensor = _configurations(name, value)
    if tensor.ndim != 1:
        raise ValueError(f"{name} has the shape {tuple(tensor.shape)}, expected (N,)")
    return tensor


def _per_joint(name: str, value: float | Sequence[float], size: int) -> Tensor:
    tensor = torch.as_tensor(value, dtype=torch.float64)
    if tensor.shape not in ((), (size,)):
        raise ValueError(
            f"{name} has the shape {tuple(tensor.shape)}, but centre has {size} coordinates: give "
            f"one number, or {size}"
        )
    return tensor.detach().clone()


def _require_same_length(name: str, value: Tensor, second: str, second_value: Tensor) -> None:
    if value.shape[-1] != second_value.shape[-1]:
        raise ValueError(
            f"{name} has {value.shape[-1]} coordinates and {second} has {second_value.shape[-1]}: "
            "expected as many"
        )
