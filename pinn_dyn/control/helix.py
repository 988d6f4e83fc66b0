"""A helix of the end effector, as a motion of the joints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from pydantic import PositiveFloat
from scipy.interpolate import make_interp_spline

from pinn_dyn.control.contracts import Motion, Reference
from pinn_dyn.control.references import smooth_step
from pinn_dyn.systems import HasLimits, HasTip

_KNOTS_PER_TURN = 64
_ITERATIONS = 300
_DAMPING = 1e-4  # of the least squares, in units of the Jacobian, m/rad
_LONGEST_STEP = 0.2  # rad
_CLOSE = 1e-10  # of the inverse kinematics: m, and rad for the step that is left
_MAX_PATH_ERROR = 1e-5  # m


class Helix(Reference):
    """The tip of an arm runs along a helix, from rest to rest, and then stands still::

        p(phi) = p_0 + radius ((cos phi - 1) e_1 + sin phi e_2) + pitch phi / (2 pi) e_3

    p_0 is the tip's position in ``posture``, with which the motion begins; e_3 is the axis, and
    (e_1, e_2, e_3) are the axes of the base in cyclic order, so a helix about z starts in the
    direction of y and has its centre ``radius`` before p_0 along x. The angle phi runs at
    2 pi / period, reached from rest, and left again, within ``rise_time`` by a quintic; velocity
    and acceleration are continuous.

    The joints follow by inverse kinematics: of all configurations that put the tip at p(phi), the
    one nearest to ``posture``, ||q - posture|| minimal, found from its neighbour by damped least
    squares (Wampler 1986; null-space motion: Liegeois 1977). So the tip's position is given and its
    orientation is not, any arm with three joints or more can do it, and a closed path closes in
    the joints as well. A quintic spline q(phi) runs through 64 such configurations per turn;
    v = q' dphi/dt and a = q'' (dphi/dt)^2 + q' d^2phi/dt^2 are its exact derivatives.

    Args:
        arm: the robot; its joint limits are checked where it has some (:class:`HasLimits`).
        posture: configuration at the start, ``(N,)``, rad.
        radius: m.
        pitch: advance along the axis in one turn, m; 0 is a circle, negative advances backwards.
        period: of one turn at full speed, s.
        turns: number of turns, not necessarily whole.
        axis: of the base, along which the helix advances.
        rise_time: s, at most turns * period; by default half a period, or the longest if shorter.

    Attributes:
        duration: turns * period + rise_time, s.
        path_error: largest distance of the tip from the helix, also between knots, m.

    Raises:
        ValueError: on a posture of another size or outside the joint limits, or a helix that the
            arm cannot follow within its joint limits.
    """

    def __init__(
        self,
        arm: HasTip,
        posture: Sequence[float],
        radius: PositiveFloat,
        pitch: float,
        period: PositiveFloat,
        turns: PositiveFloat,
        axis: Literal["x", "y", "z"] = "z",
        rise_time: PositiveFloat | None = None,
    ):
        longest = turns * period
        rise_time = min(0.5 * period, longest) if rise_time is None else rise_time
        if rise_time > longest:
            raise ValueError(
                f"rise_time is {rise_time:g} s, expected at most turns * period = {longest:g} s"
            )
        home = np.asarray(posture, dtype=float)
        if home.shape != (arm.num_coordinates,):
            raise ValueError(
                f"posture has {home.size} entries, expected {arm.num_coordinates}, one for each "
                "joint of the robot"
            )
        self.num_coordinates = arm.num_coordinates
        self.rise_time, self.duration = float(rise_time), float(longest + rise_time)
        self._omega = 2 * math.pi / period
        self._end = 2 * math.pi * turns
        self._radius, self._slope = radius, pitch / (2 * math.pi)
        self._axes = np.roll(np.eye(3), -("xyz".index(axis) + 1), axis=0)
        self._origin = _tip(arm, home)

        knots = np.linspace(0.0, self._end, max(6, math.ceil(_KNOTS_PER_TURN * turns)) + 1)
        q = np.empty((len(knots), arm.num_coordinates))
        guess = home
        for k, phi in enumerate(knots):
            q[k] = guess = self._solve(arm, home, guess, phi)
        self._curve = make_interp_spline(knots, q, k=5)
        self._slopes = self._curve.derivative(1), self._curve.derivative(2)
        between = (knots[:-1, None] + np.diff(knots)[:, None] * [0.25, 0.5, 0.75]).ravel()
        self.path_error = self._measure(arm, between)

    def path(self, t: float) -> np.ndarray:
        """Return the desired tip position at time t in s, ``(3,)``, m, in the frame of the base."""
        return self._point(self._angle(t)[0])

    def __call__(self, t: float) -> Motion:
        phi, rate, rate2 = self._angle(t)
        slope, slope2 = (derivative(phi) for derivative in self._slopes)
        motion = self._curve(phi), rate * slope, rate**2 * slope2 + rate2 * slope
        return Motion(*(torch.from_numpy(value) for value in motion))

    def _angle(self, t: float) -> tuple[float, float, float]:
        """Return phi in rad and its derivatives: the rate rises by s(x) and falls likewise."""
        if t > 0.5 * self.duration:
            phi, rate, rate2 = self._angle(max(self.duration - t, 0.0))
            return self._end - phi, rate, -rate2
        x = max(t, 0.0) / self.rise_time
        s, slope, _ = smooth_step(x)
        # The integral of the quintic s from 0 to x, and 1/2 + (x - 1) beyond its end.
        risen = x**4 * (2.5 - 3 * x + x**2) if x < 1 else x - 0.5
        return (
            self._omega * self.rise_time * risen,
            self._omega * s,
            self._omega / self.rise_time * slope,
        )

    def _point(self, phi: float) -> np.ndarray:
        r = self._radius
        shift = np.array([r * (math.cos(phi) - 1), r * math.sin(phi), self._slope * phi])
        return self._origin + shift @ self._axes

    def _solve(self, arm: HasTip, home: np.ndarray, guess: np.ndarray, phi: float) -> np.ndarray:
        """Return the configuration nearest to ``home`` that puts the tip at p(phi)."""
        target, q = self._point(phi), guess
        for _ in range(_ITERATIONS):
            tip, jacobian = _tip_and_jacobian(arm, q)
            error = target - tip
            left, values, rows = np.linalg.svd(jacobian, full_matrices=False)
            homing = home - q  # only the part in the null space is used
            change = homing + rows.T @ (
                values / (values**2 + _DAMPING**2) * (left.T @ error) - rows @ homing
            )
            length = float(np.linalg.norm(change))
            if np.linalg.norm(error) < _CLOSE and length < _CLOSE:
                self._require_within_limits(arm, q, phi)
                return q
            q = q + change * min(1.0, _LONGEST_STEP / max(length, _CLOSE))
        raise ValueError(
            f"the arm cannot follow the helix: at t = {self._time(phi):.4g} s its tip should be at "
            f"{np.round(target, 4).tolist()} m, and after {_ITERATIONS} steps the inverse "
            f"kinematics are {np.linalg.norm(error):.3g} m from it and still moving, as at the "
            "edge of the reach: take a smaller radius or pitch, fewer turns, or another posture"
        )

    def _measure(self, arm: HasTip, angles: np.ndarray) -> float:
        """Return the largest path error at the angles, and check the joint limits there."""
        q = self._curve(angles)
        for row, phi in zip(q, angles, strict=True):
            self._require_within_limits(arm, row, phi)
        points = np.array([self._point(phi) for phi in angles])
        errors = np.linalg.norm(_tip(arm, q) - points, axis=-1)
        worst = int(np.argmax(errors))
        if not errors[worst] < _MAX_PATH_ERROR:
            raise ValueError(
                f"the joints cannot follow the helix smoothly: at t = "
                f"{self._time(angles[worst]):.4g} s the tip is {errors[worst]:.3g} m beside it, "
                f"allowed is {_MAX_PATH_ERROR:g} m, as near a singular configuration: take a "
                "smaller radius or pitch, or another posture"
            )
        return float(errors[worst])

    def _require_within_limits(self, arm: HasTip, q: np.ndarray, phi: float) -> None:
        if not isinstance(arm, HasLimits):
            return
        outside = (q < arm.q_low - 1e-9) | (q > arm.q_high + 1e-9)
        if outside.any():
            i = int(np.argmax(outside))
            raise ValueError(
                f"the arm cannot follow the helix within its joint limits: at "
                f"t = {self._time(phi):.4g} s joint {arm.joint_names[i]!r} would be at "
                f"{q[i]:.4g} rad, allowed are {arm.q_low[i]:.4g} to {arm.q_high[i]:.4g} rad: take "
                "a smaller radius or pitch, or another posture"
            )

    def _time(self, phi: float) -> float:
        """Return the time at which the angle is phi, s, for messages."""
        times = np.linspace(0.0, self.duration, 10_001)
        return float(np.interp(phi, [self._angle(t)[0] for t in times], times))


def _tip(arm: HasTip, q: np.ndarray) -> np.ndarray:
    return arm.tip_position(torch.from_numpy(q)).numpy()


def _tip_and_jacobian(arm: HasTip, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the tip's position ``(3,)`` and its derivative with respect to q, ``(3, N)``."""
    with torch.enable_grad():
        x = torch.from_numpy(q).requires_grad_()
        tip = arm.tip_position(x)
        rows = [torch.autograd.grad(entry, x, retain_graph=True)[0] for entry in tip]
    return tip.detach().numpy(), torch.stack(rows).numpy()
