"""What a robot may offer beyond its equation of motion; a class of your own just has the methods.

References, plants, limits and animations ask for these and for no class.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from torch import Tensor


@runtime_checkable
class HasTip(Protocol):
    """A robot with an end effector, which can follow a path."""

    num_coordinates: int

    def tip_position(self, q: Tensor) -> Tensor:
        """Position of the tip in the frame of the base, ``(*batch, 3)``, m; differentiable."""


@runtime_checkable
class HasLimits(Protocol):
    """A robot with limits.

    Attributes:
        joint_names: names of the coordinates, N.
        q_low, q_high: limits of the configuration, ``(N,)``, rad or m.
        v_max: limits of the speeds, ``(N,)``.
        u_max: limits of the inputs, ``(M,)``.
    """

    joint_names: list[str]
    q_low: np.ndarray
    q_high: np.ndarray
    v_max: np.ndarray
    u_max: np.ndarray


@runtime_checkable
class HasDomain(Protocol):
    """A system that knows where its equation of motion holds."""

    def check_domain(self, q_low: np.ndarray, q_high: np.ndarray) -> None:
        """Raise a ValueError unless it holds for all q from ``q_low`` to ``q_high``, ``(N,)``."""


@runtime_checkable
class Stepped(Protocol):
    """A robot whose simulator moves it in steps of its own."""

    num_coordinates: int
    num_inputs: int

    def set_state(self, q: np.ndarray, v: np.ndarray) -> None:
        """Put it into a state, ``(N,)`` each, from which :meth:`step` moves it."""

    def step(self, torque: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """q and v, ``(N,)`` each, after a step of ``step`` s under an input ``(M,)``."""


@runtime_checkable
class Drawable(Protocol):
    """A robot that is drawn as lines, from its base to its tip.

    Attributes:
        z_is_down: whether z points downwards.
    """

    z_is_down: bool

    def lines(self, q: Tensor) -> Tensor:
        """S lines of P points each, ``(*batch, S, P, 3)``, m; the last point is the tip."""
