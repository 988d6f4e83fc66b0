"""A motion of the joints that moves the end effector along a helix."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import scipy
import torch
from pydantic import PositiveFloat

from pinn_dyn.control.contracts import Motion, Reference
from pinn_dyn.control.references import smooth_step
from pinn_dyn.systems import HasTip

_KNOTS_PER_TURN = 64
_ITERATIONS = 300
_DAMPING = 1e-4  # of the least squares, in units of the Jacobian, m/rad
_LONGEST_STEP = 0.2  # rad
_CLOSE = 1e-10  # of the inverse kinematics: m, and rad for the step that is left
_MAX_PATH_ERROR = 1e-5  # m


class Helix(Reference):
    """Motion of an arm whose tip moves along a helix, from rest to rest, and then stands still::

        p(phi) = p_0 + radius ((cos phi - 1) e_1 + sin phi e_2) + pitch phi / (2 pi) e_3

    p_0 is the tip position in ``posture``, e_3 is the axis, and (e_1, e_2, e_3) are the axes of
    the base in cyclic order: a helix about z starts along y. The angle phi grows at 2 pi / period
    per second. A quintic of length ``rise_time`` starts and stops the motion.

    Damped least squares (Wampler 1986) with null-space motion (Liegeois 1977) give the
    configuration nearest to ``posture`` that puts the tip at p(phi); the orientation is free. A
    quintic spline runs through 64 such configurations per turn and has exact derivatives.

    Args:
        arm: the robot.
        posture: configuration at the start, ``(N,)``, rad.
        radius: radius of the helix, m.
        pitch: advance along the axis in one turn, m; 0 is a circle.
        period: duration of one turn at full speed, s.
        turns: number of turns.
        axis: axis of the base along which the helix advances.
        rise_time: duration of the start and of the stop, s, at most turns * period; None for half a
            period.

    Attributes:
        duration: turns * period + rise_time, s.
        path_error: largest distance of the tip from the helix, at and between the knots, m.

    Raises:
        ValueError: if the arm cannot follow the helix, or the rise time is too long.
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
            raise ValueError(f"rise_time is {rise_time:g} s, longer than turns * period")
        home = np.asarray(posture, dtype=float)
        self.num_coordinates = arm.num_coordinates
        self.rise_time, self.duration = float(rise_time), float(longest + rise_time)
        self._omega = 2 * math.pi / period
        self._end = 2 * math.pi * turns
        self._radius, self._slope = radius, pitch / (2 * math.pi)
        self._axes = np.roll(np.eye(3), -("xyz".index(axis) + 1), axis=0)
        self._origin = _tip(arm, home)

        knots = np.linspace(0.0, self._end, max(6, math.ceil(_KNOTS_PER_TURN * turns)) + 1)
        q = [home]
        for phi in knots:
            q.append(self._solve(arm, home, q[-1], phi))
        self._curve = scipy.interpolate.make_interp_spline(knots, q[1:], k=5)
        self._slopes = self._curve.derivative(1), self._curve.derivative(2)
        between = (knots[:-1, None] + np.diff(knots)[:, None] * [0.25, 0.5, 0.75]).ravel()
        points = np.array([self._point(phi) for phi in between])
        errors = np.linalg.norm(_tip(arm, self._curve(between)) - points, axis=-1)
        self.path_error = float(errors.max())
        if not self.path_error < _MAX_PATH_ERROR:
            raise ValueError(
                f"near phi = {between[errors.argmax()]:.3g} rad the tip misses the helix by "
                f"{self.path_error:.3g} m: take a smaller radius or pitch, or another posture"
            )

    def path(self, t: float) -> np.ndarray:
        """Return the desired tip position at time t in s, ``(3,)``, m, in the base frame."""
        return self._point(self._angle(t)[0])

    def __call__(self, t: float) -> Motion:
        phi, rate, rate2 = self._angle(t)
        slope, slope2 = (derivative(phi) for derivative in self._slopes)
        motion = self._curve(phi), rate * slope, rate**2 * slope2 + rate2 * slope
        return Motion(*(torch.from_numpy(value) for value in motion))

    def _angle(self, t: float) -> tuple[float, float, float]:
        """Return phi in rad and its derivatives. The rate rises by s(x) and falls by 1 - s(x)."""
        if t > 0.5 * self.duration:
            phi, rate, rate2 = self._angle(max(self.duration - t, 0.0))
            return self._end - phi, rate, -rate2
        x = max(t, 0.0) / self.rise_time
        s, slope, _ = smooth_step(x)
        # The integral of the quintic s from 0 to x, and 1/2 + (x - 1) beyond its end.
        risen = x**4 * (2.5 - 3 * x + x**2) if x < 1 else x - 0.5
        phi = self._omega * self.rise_time * risen
        return phi, self._omega * s, self._omega / self.rise_time * slope

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
                return q
            q = q + change * min(1.0, _LONGEST_STEP / max(length, _CLOSE))
        raise ValueError(
            f"the arm cannot follow the helix: at phi = {phi:.3g} rad its tip stays "
            f"{np.linalg.norm(error):.3g} m away: take a smaller radius or another posture"
        )


def _tip(arm: HasTip, q: np.ndarray) -> np.ndarray:
    return arm.tip_position(torch.from_numpy(q)).numpy()


def _tip_and_jacobian(arm: HasTip, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    with torch.enable_grad():
        x = torch.from_numpy(q).requires_grad_()
        tip = arm.tip_position(x)
        rows = [torch.autograd.grad(entry, x, retain_graph=True)[0] for entry in tip]
    return tip.detach().numpy(), torch.stack(rows).numpy()
