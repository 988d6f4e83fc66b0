"""Protocols of optional features of a robot: tip, limits, domain, simulation, drawing."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from torch import Tensor


@runtime_checkable
class HasTip(Protocol):
    """A robot with an end effector that can follow a path."""

    num_coordinates: int

    def tip_position(self, q: Tensor) -> Tensor:
        """Return the position of the tip in the base frame, ``(*batch, 3)``, m; differentiable."""


@runtime_checkable
class HasLimits(Protocol):
    """A robot with limits of configurations and speeds, ``(N,)``, and of inputs, ``(M,)``."""

    joint_names: list[str]
    q_low: np.ndarray
    q_high: np.ndarray
    v_max: np.ndarray
    u_max: np.ndarray


@runtime_checkable
class HasDomain(Protocol):
    """A system that knows the configurations at which its equation of motion holds."""

    def check_domain(self, q_low: np.ndarray, q_high: np.ndarray) -> None:
        """Raise a ValueError if it fails for a q from ``q_low`` to ``q_high``, ``(N,)`` each."""


@runtime_checkable
class Stepped(Protocol):
    """A robot that a simulator moves in time steps."""

    num_coordinates: int
    num_inputs: int

    def set_state(self, q: np.ndarray, v: np.ndarray) -> None:
        """Set the state q, v, ``(N,)`` each, at which the next :meth:`step` starts."""

    def step(self, torque: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Return q and v, ``(N,)`` each, after ``step`` s under an input ``(M,)``."""


@runtime_checkable
class Drawable(Protocol):
    """A robot that can be drawn as lines from its base to its tip."""

    z_is_down: bool

    def lines(self, q: Tensor) -> Tensor:
        """Return S lines of P points, ``(*batch, S, P, 3)``, m; the last point is the tip."""
