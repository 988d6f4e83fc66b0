"""Excitation of a robot with joint limits: tracked references and direct torques."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
import torch
from pydantic import Field, PositiveFloat, PositiveInt

from pinn_dyn.data.excitation import Bounds, MultiSine
from pinn_dyn.systems import SimulatedArm

_CHECK_STEP = 0.02  # s, fine enough for references of a few Hz

Fraction = Annotated[float, Field(gt=0, le=1)]
Generators = Sequence[np.random.Generator]


class DrawnMotion(NamedTuple):
    """K motions to record: initial states ``(K, N)`` and laws u_k = torque(k, q_k, v_k)."""

    q0: np.ndarray
    v0: np.ndarray
    torque: Callable[[int, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class RobotExcitation(abc.ABC):
    """A family of random motions of a robot. Its fields are a part of the cache key."""

    @abc.abstractmethod
    def draw(self, robot: SimulatedArm, t: np.ndarray, rngs: Generators) -> DrawnMotion:
        """Draw a motion from each generator for the sample times ``t`` ``(T,)``, s."""


@dataclass(frozen=True)
class TrackedMultiSine(RobotExcitation):
    """Multi-sine joint references, tracked by computed torque and PD::

        r_i(t) = centre_i + amplitude_i sum_h w_ih sin(2 pi f_ih t + phi_ih),   sum_h w_ih = 1
        u = M(q) (d2r/dt2 + 2 w (dr/dt - v) + w^2 (r - q)) + C v + G + D v,   w = bandwidth

    The robot starts on the reference. The frequencies of a joint are reduced until its peak speed
    is within ``speed``. Then all frequencies are reduced until the torque along the reference is
    within ``torque``.

    Source: sums of sines: Swevers et al. 1997 (IEEE Trans. Robotics and Automation 13(5)); computed
    torque: Murray, Li, Sastry 1994, eq. (4.51).

    Args:
        frequency: [low, high] in Hz; f_ih is uniform in its logarithm.
        harmonics: number of sines.
        reach: fraction of the joint ranges.
        amplitude: [low, high] of each joint's amplitude, as a fraction of the reach.
        speed: fraction of the velocity limits.
        torque: fraction of the torque limits.
        bandwidth: bandwidth of the controller, rad/s.

    Raises:
        ValueError: by :meth:`draw`, if the torque against gravity exceeds the allowed torque.
    """

    frequency: Bounds
    reach: Fraction
    amplitude: Annotated[Sequence[Fraction], Field(min_length=2, max_length=2)]
    speed: Fraction
    torque: Fraction
    harmonics: PositiveInt = 4
    bandwidth: PositiveFloat = 10.0

    def draw(self, robot: SimulatedArm, t: np.ndarray, rngs: Generators) -> DrawnMotion:
        """Draw references and their tracking law."""
        draws = [self._draw_sines(robot, float(t[-1]), rng) for rng in rngs]
        centre, *sines = (np.stack(values) for values in zip(*draws, strict=True))
        w = self.bandwidth

        def law(k: int, q: np.ndarray, v: np.ndarray) -> np.ndarray:
            q_ref, v_ref, a_ref = _reference(t[k], centre, *sines)
            return robot.motor_torque(q, v, a_ref + 2 * w * (v_ref - v) + w**2 * (q_ref - q))

        q0, v0, _ = _reference(t[0], centre, *sines)
        return DrawnMotion(q0, v0, law)

    def _draw_sines(
        self, robot: SimulatedArm, duration: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, ...]:
        """Draw arguments of :func:`_reference` that keep the motion within the limits."""
        size = robot.num_coordinates
        half = self.reach * (robot.q_high - robot.q_low) / 2
        smallest, largest = self.amplitude
        amplitude = half * rng.uniform(smallest, largest, size)
        middle = (robot.q_low + robot.q_high) / 2
        centre = middle + (half - amplitude) * rng.uniform(-1, 1, size)
        shape = (size, self.harmonics)
        low, high = np.log(self.frequency)
        rate = 2 * np.pi * np.exp(rng.uniform(low, high, shape))
        phase = rng.uniform(0, 2 * np.pi, shape)
        weight = amplitude[:, None] * rng.dirichlet(np.ones(self.harmonics), size)
        grid = np.arange(0.0, duration, _CHECK_STEP)[:, None, None]
        peak = np.abs(_reference(grid, centre, weight, rate, phase)[1]).max(0)
        # Slower sines cover a part of the same shape. The peak speed falls with the frequency.
        rate *= np.minimum(1.0, self.speed * robot.v_max / peak)[:, None]
        for _ in range(20):
            u = robot.motor_torque(*_reference(grid, centre, weight, rate, phase))
            use = np.abs(u).max(0) / (self.torque * robot.u_max)
            if use.max() <= 1:
                return centre, weight, rate, phase
            rate *= 0.9
        joint = int(use.argmax())
        raise ValueError(
            f"TrackedMultiSine: even a slow reference takes {use[joint]:.2f} of the torque allowed "
            f"at joint {robot.joint_names[joint]!r}: raise torque or lower reach"
        )


def _reference(
    t: np.ndarray, centre: np.ndarray, weight: np.ndarray, rate: np.ndarray, phase: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q, v and a of multi-sines ``(..., N, harmonics)``."""
    angle = rate * t + phase
    q = centre + (weight * np.sin(angle)).sum(-1)
    v = (weight * rate * np.cos(angle)).sum(-1)
    return q, v, -(weight * rate**2 * np.sin(angle)).sum(-1)


@dataclass(frozen=True)
class TorqueMultiSine(RobotExcitation):
    """Multi-sine torques on an arm with gravity compensation and springs to its center::

        u_i = G_i(q) + k_i (centre_i - q_i) - c_i v_i + s_i(t)

    s_i is a multi-sine with a peak of up to ``amplitude`` times the torque limit. At this peak, the
    static displacement of the spring k_i is ``reach`` times the distance from the center to the
    nearer limit. c_i is the critical damping for M_ii(centre). The center is drawn from the middle
    half of the range. The robot starts at rest in the equilibrium of spring and torque.

    Args:
        frequency: [low, high] of the sines in Hz, uniform in the logarithm.
        harmonics: number of sines.
        amplitude: peak of the multi-sines, as a fraction of the torque limits.
        reach: static displacement, as a fraction of the distance to the nearer limit.
    """

    frequency: Bounds
    amplitude: Fraction
    reach: Fraction
    harmonics: PositiveInt = 4

    def draw(self, robot: SimulatedArm, t: np.ndarray, rngs: Generators) -> DrawnMotion:
        """Draw torque signals and centers."""
        half = (robot.q_high - robot.q_low) / 2
        peak = self.amplitude * robot.u_max
        sines = MultiSine([0.0] * len(peak), peak.tolist(), self.frequency, self.harmonics)
        draws = [
            (half * rng.uniform(-0.5, 0.5, len(half)), sines.draw(1, float(t[-1]), rng)(t)[0])
            for rng in rngs
        ]
        offset, signal = (np.stack(values) for values in zip(*draws, strict=True))
        centre = (robot.q_low + robot.q_high) / 2 + offset
        stiffness = peak / (self.reach * np.minimum(centre - robot.q_low, robot.q_high - centre))
        inertia = robot.mass_matrix(torch.from_numpy(centre)).diagonal(dim1=-2, dim2=-1).numpy()
        friction = 2 * np.sqrt(stiffness * inertia)
        zero = np.zeros_like(centre)

        def law(k: int, q: np.ndarray, v: np.ndarray) -> np.ndarray:
            gravity = robot.motor_torque(q, zero, zero)
            return gravity + stiffness * (centre - q) - friction * v + signal[:, k]

        return DrawnMotion(centre + signal[:, 0] / stiffness, zero, law)
