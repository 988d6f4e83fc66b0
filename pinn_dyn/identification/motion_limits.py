"""Limits of a motion at the joints of a robot and at its tip."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from pinn_dyn.systems import RigidChain
from pinn_dyn.wording import did_you_mean

log = logging.getLogger(__name__)

JointValues = float | Sequence[float] | Mapping[str, float] | None
"""A number for all joints, N numbers, or numbers by joint name; else the default."""


@dataclass(frozen=True, kw_only=True)
class MotionLimits:
    """Limits of a motion; joints without a number have the limits of the URDF.

    Args:
        low, high: positions, rad or m.
        velocity: rad/s or m/s; 1 rad/s or 0.2 m/s where the URDF has none.
        acceleration: rad/s^2 or m/s^2; by default three times the velocity limit per second.
        torque: Nm or N; unlimited where the URDF has none.
        share: fraction of the limits, and of the position ranges about their middle, to use.
        lowest_tip: smallest height of the tip's frame above the base's, m.
    """

    low: JointValues = None
    high: JointValues = None
    velocity: JointValues = None
    acceleration: JointValues = None
    torque: JointValues = None
    share: Annotated[float, Field(gt=0, le=1)] = 0.9
    lowest_tip: float | None = None


class Envelope:
    """The limits of a robot as tensors ``(N,)``, and the part of them that a motion uses.

    Args:
        robot: joints, masses and the limits of the URDF.
        limits: replace those of the URDF.
        start: pose at the start and the end, in the middle of the ranges by default.

    Raises:
        ValueError: on an unknown joint, an empty range, or a start that violates a limit.
    """

    def __init__(self, robot: RigidChain, limits: MotionLimits, start: JointValues = None):
        self.robot, self.lowest_tip = robot, limits.lowest_tip
        low, high, velocity, torque = robot.limits.T
        low, high = self._filled("low", limits.low, low), self._filled("high", limits.high, high)
        if empty := self._names(~(low < high)):
            raise ValueError(f"no position range of {empty}: set limits.low and limits.high")
        middle, half = (low + high) / 2, limits.share * (high - low) / 2
        slow = np.where(robot.turning, 1.0, 0.2)
        velocity = self._filled("velocity", limits.velocity, velocity)
        if unlimited := self._names(~(velocity > 0)):
            log.warning(
                "no velocity limit of %s: 1 rad/s or 0.2 m/s is used, set limits.velocity",
                unlimited,
            )
        velocity = np.where(velocity > 0, velocity, slow)
        torque = self._filled("torque", limits.torque, torque)
        acceleration = self._filled("acceleration", limits.acceleration, 3 * velocity)
        self.start = torch.from_numpy(self._filled("start", start, middle))
        massless = robot.mass_matrix(self.start).diagonal().numpy() < 1e-9
        if unlimited := self._names(massless | ~(torque > 0)):
            log.warning(
                "the torque of %s is not limited: the URDF has no limit, or no mass behind them",
                unlimited,
            )
        torque = np.where(torque > 0, torque, math.inf)
        self.low, self.high = torch.from_numpy(middle - half), torch.from_numpy(middle + half)
        self.velocity, self.acceleration, self.torque = (
            torch.from_numpy(limits.share * x) for x in (velocity, acceleration, torque)
        )
        inside = (self.low < self.start) & (self.start < self.high)
        if outside := self._names(~inside.numpy()):
            raise ValueError(
                f"the start of {outside} is outside the limits: set start to a pose within them"
            )
        zero = torch.zeros_like(self.start)
        tau = self.torque_for(self.start, zero, zero)
        if heavy := self._names((tau.abs() > self.torque).numpy()):
            raise ValueError(
                f"holding the arm at the start takes more torque than the limits of {heavy}: set "
                "start to a pose that takes less, or limits.torque"
            )
        if float(self.depth(self.start)) > 0:
            raise ValueError(f"the tip starts below {self.lowest_tip} m: set a higher start")

    def depth(self, q: Tensor) -> Tensor:
        """Return the depth of the tip below its smallest height, ``(*batch,)``, m."""
        if self.lowest_tip is None:
            return torch.zeros_like(q[..., 0])
        return (self.lowest_tip - self.robot.tip_position(q)[..., 2]).clamp(min=0)

    def scale(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """Return the largest use of position, velocity and acceleration of q - start, ``(*, N)``.

        The arguments ``(*batch, T, N)`` are deviations from the start.
        """
        up, down = q / (self.high - self.start), -q / (self.start - self.low)
        uses = (up, down, v.abs() / self.velocity, a.abs() / self.acceleration)
        return torch.stack([x.amax(-2) for x in uses]).amax(0)

    def torque_for(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """Return the torque along a motion by the inertias of the URDF, ``(*batch, N)``."""
        return self.robot.rigid_force(q, v, a) + self.robot.dissipative_force(q, v)

    def uses(self, q: Tensor, v: Tensor, a: Tensor, tau: Tensor) -> dict[str, Tensor]:
        """Return the part of each limit that a motion uses, ``(*batch, T, N)`` each."""
        middle, half = (self.high + self.low) / 2, (self.high - self.low) / 2
        values = ((q - middle) / half, v / self.velocity, a / self.acceleration, tau / self.torque)
        names = ("position", "velocity", "acceleration", "torque")
        return {name: x.abs() for name, x in zip(names, values, strict=True)}

    def _names(self, mask: np.ndarray) -> str:
        return ", ".join(x for x, bad in zip(self.robot.joint_names, mask, strict=True) if bad)

    def _filled(self, name: str, values: JointValues, default: np.ndarray) -> np.ndarray:
        """Return the numbers of all joints, ``(N,)``."""
        names = self.robot.joint_names
        if values is None:
            return default.copy()
        if isinstance(values, Mapping):
            if unknown := [x for x in values if x not in names]:
                hint = did_you_mean(unknown[0], names)
                raise ValueError(f"{name}: no joint {unknown[0]!r}{hint or '.'} Joints: {names}")
            return np.array([values.get(x, y) for x, y in zip(names, default, strict=True)])
        numbers = np.asarray(values, dtype=float)
        if numbers.shape not in ((), (len(names),)):
            raise ValueError(
                f"{name} has {numbers.size} numbers, expected one or one for each of {names}"
            )
        return np.broadcast_to(numbers, len(names)).copy()
