"""Excitation of a robot with joint limits: tracked references and direct torques."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple, Protocol, runtime_checkable

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from pinn_dyn.data.excitation import Bounds, MultiSine
from pinn_dyn.systems import HasLimits, Stepped

# Fine enough for references of a few Hz.
_CHECK_STEP = 0.02

Fraction = Annotated[float, Field(gt=0, le=1)]


@runtime_checkable
class Robot(HasLimits, Stepped, Protocol):
    """A robot that a recording can move, beyond being a mechanical system with A = I."""

    def describe(self) -> dict[str, object]:
        """Return everything the motion depends on, JSON-serializable."""

    def dynamics(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return M ``(N, N)`` and C v + G + D v ``(N,)`` at one state."""


class Plan(NamedTuple):
    """One motion to record: initial state ``(N,)`` and torque law u_k = torque(k, q_k, v_k)."""

    q0: np.ndarray
    v0: np.ndarray
    torque: Callable[[int, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class RobotExcitation(abc.ABC):
    """A family of random motions of a robot; a dataclass, as its fields are part of a cache key."""

    @abc.abstractmethod
    def draw(self, robot: Robot, t: np.ndarray, rng: np.random.Generator) -> Plan:
        """Draw one motion for the sample times ``t`` ``(T,)``, s."""


@dataclass(frozen=True)
class TrackedMultiSine(RobotExcitation):
    """Multi-sine joint references, tracked by computed torque and PD::

        r_i(t) = centre_i + amplitude_i sum_h w_ih sin(2 pi f_ih t + phi_ih),   sum_h w_ih = 1
        u = M(q) (d2r/dt2 + 2 w (dr/dt - v) + w^2 (r - q)) + C v + G + D v,   w = bandwidth

    The robot starts on the reference. References lie within ``reach`` of the joint ranges; small
    amplitudes make fast motions, from which inertia is learned, large ones see more of gravity. A
    joint's frequencies are lowered until
    its peak speed is within ``speed``, all of them together until the torque along the reference
    is within ``torque``.

    Source: Swevers et al. 1997 (IEEE Trans. Robotics and Automation 13(5)), excitation by sums of
    sines; computed torque: Murray, Li, Sastry 1994, eq. (4.51).

    Args:
        frequency: [low, high] in Hz; each f_ih is drawn from it, uniform in its logarithm.
        harmonics: number of sines.
        reach: fraction of the joint ranges.
        amplitude: [low, high] of each joint's amplitude, as a fraction of the reach.
        speed: fraction of the velocity limits.
        torque: fraction of the torque limits.
        bandwidth: of the controller, rad/s.

    Raises:
        ValueError: from :meth:`draw` if holding the arm up takes more than the torque allowed.
    """

    frequency: Bounds
    harmonics: PositiveInt
    reach: Fraction
    amplitude: Annotated[Sequence[Fraction], Field(min_length=2, max_length=2)]
    speed: Fraction
    torque: Fraction
    bandwidth: PositiveFloat

    def draw(self, robot: Robot, t: np.ndarray, rng: np.random.Generator) -> Plan:
        """Draw a reference and its tracking law."""
        size = len(robot.q_low)
        half = self.reach * (robot.q_high - robot.q_low) / 2
        smallest, largest = self.amplitude
        amplitude = half * rng.uniform(smallest, largest, size)
        middle = (robot.q_low + robot.q_high) / 2
        centre = middle + (half - amplitude) * rng.uniform(-1, 1, size)
        shape = (size, self.harmonics)
        low, high = np.log(self.frequency)
        frequency = np.exp(rng.uniform(low, high, shape))
        phase = rng.uniform(0, 2 * np.pi, shape)
        weight = amplitude[:, None] * rng.dirichlet(np.ones(self.harmonics), size)

        def reference(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            rate = 2 * np.pi * frequency
            angle = rate * t[:, None, None] + phase
            q = centre + (weight * np.sin(angle)).sum(-1)
            v = (weight * rate * np.cos(angle)).sum(-1)
            return q, v, -(weight * rate**2 * np.sin(angle)).sum(-1)

        grid = np.arange(0.0, t[-1], _CHECK_STEP)
        peak = np.abs(reference(grid)[1]).max(0)
        # Slower sines run through a part of the same shape, so the peak falls with the frequency.
        frequency *= np.minimum(1.0, self.speed * robot.v_max / peak)[:, None]
        for _ in range(20):
            use = self._torque_use(robot, *reference(grid))
            if use.max() <= 1:
                break
            frequency *= 0.9
        else:
            joint = int(use.argmax())
            raise ValueError(
                f"TrackedMultiSine: even a slow reference takes {use[joint]:.2f} of the torque "
                f"allowed at joint {robot.joint_names[joint]!r} ({self.torque:g} of its limit "
                f"{robot.u_max[joint]:g} Nm): raise torque, lower reach, or check the URDF's effort"
            )
        q_ref, v_ref, a_ref = reference(t)
        w = self.bandwidth

        def law(k: int, q: np.ndarray, v: np.ndarray) -> np.ndarray:
            mass, bias = robot.dynamics(q, v)
            return mass @ (a_ref[k] + 2 * w * (v_ref[k] - v) + w**2 * (q_ref[k] - q)) + bias

        return Plan(q_ref[0], v_ref[0], law)

    def _torque_use(self, robot: Robot, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Largest torque along a reference over the torque allowed, ``(N,)``."""
        terms = (robot.dynamics(*state) for state in zip(q, v, strict=True))
        u = np.array([mass @ a_k + bias for (mass, bias), a_k in zip(terms, a, strict=True)])
        return np.abs(u).max(0) / (self.torque * robot.u_max)


@dataclass(frozen=True)
class TorqueMultiSine(RobotExcitation):
    """Multi-sine torques on an arm that gravity does not pull and springs keep in its range::

        u_i = G_i(q) + k_i (centre_i - q_i) - c_i v_i + s_i(t)

    s_i is a multi-sine with a peak of up to ``amplitude`` of the torque limit. The spring k_i is so
    stiff that a constant s_i at its peak would move the joint by ``reach`` of the way from the
    centre to the nearer limit; c_i damps it critically for the inertia M_ii(centre). The centre is
    drawn from the middle half of the range. The robot starts at rest where spring and torque
    balance: a jump in the acceleration would weigh heavily in a squared loss.

    Args:
        frequency: [low, high] in Hz; each sine's is drawn from it, uniform in its logarithm.
        harmonics: number of sines.
        amplitude: peak of the multi-sines, as a fraction of the torque limits.
        reach: static displacement, as a fraction of the way to the nearer limit.
    """

    frequency: Bounds
    harmonics: PositiveInt
    amplitude: Fraction
    reach: Fraction

    def draw(self, robot: Robot, t: np.ndarray, rng: np.random.Generator) -> Plan:
        """Draw a torque signal and a centre."""
        size = len(robot.q_low)
        half = (robot.q_high - robot.q_low) / 2
        centre = (robot.q_low + robot.q_high) / 2 + half * rng.uniform(-0.5, 0.5, size)
        way = self.reach * np.minimum(centre - robot.q_low, robot.q_high - centre)
        peak = self.amplitude * robot.u_max
        sines = MultiSine([0.0] * size, peak.tolist(), self.frequency, self.harmonics)
        signal = sines.draw(1, float(t[-1]), rng)(t)[0]
        rest = np.zeros(size)
        stiffness = peak / way
        friction = 2 * np.sqrt(stiffness * np.diag(robot.dynamics(centre, rest)[0]))

        def law(k: int, q: np.ndarray, v: np.ndarray) -> np.ndarray:
            gravity = robot.dynamics(q, rest)[1]
            return gravity + stiffness * (centre - q) - friction * v + signal[k]

        return Plan(centre + signal[0] / stiffness, rest, law)
