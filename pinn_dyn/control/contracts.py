"""The three contracts of a control loop: reference, controller and plant."""

from __future__ import annotations

import abc
from typing import NamedTuple

from torch import Tensor


class Motion(NamedTuple):
    """What a reference asks for at one time.

    ``q`` configuration, ``v`` velocity, ``a`` acceleration, each ``(*batch, N)``; SI units, rad.
    """

    q: Tensor
    v: Tensor
    a: Tensor


class Reference(abc.ABC):
    """A desired motion q_ref(t) with its exact first and second derivatives."""

    num_coordinates: int

    @abc.abstractmethod
    def __call__(self, t: float) -> Motion:
        """The desired motion at time t in s, ``(N,)`` each or ``(K, N)`` for K of them."""


class Controller(abc.ABC):
    """A control law u = u(t, q, v, reference), batched.

    Attributes:
        num_coordinates: N, the dimension of q.
        num_inputs: M, the dimension of u.
    """

    def __init__(self, num_coordinates: int, num_inputs: int):
        self.num_coordinates = num_coordinates
        self.num_inputs = num_inputs

    def reset(self) -> None:  # noqa: B027 - most laws have no memory
        """Forget the past, before a new run."""

    @abc.abstractmethod
    def __call__(self, t: float, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        """The input u ``(*batch, M)`` at time t in s, from the measured q and v ``(*batch, N)``."""

    def diagnostics(self) -> dict[str, Tensor]:
        """Named numbers about the latest call, ``(*batch,)`` each, which the loop records."""
        return {}

    def faults(self) -> dict[str, Tensor]:
        """Reasons to stop after the latest call, each with a mask ``(*batch,)`` of whom."""
        return {}


class Plant(abc.ABC):
    """What is controlled: K copies of a robot, started and moved together.

    Attributes:
        num_coordinates: N, the dimension of q.
        num_inputs: M, the dimension of u.
    """

    num_coordinates: int
    num_inputs: int

    @abc.abstractmethod
    def start(self, q0: Tensor, v0: Tensor) -> None:
        """Put the K copies into their initial states, ``(K, N)`` each."""

    @abc.abstractmethod
    def advance(self, u: Tensor, duration: float) -> tuple[Tensor, Tensor]:
        """Hold the input u ``(K, M)`` for a time in s; returns q and v after it, ``(K, N)`` each.

        A copy that leaves the finite numbers, or that its solver cannot follow, comes back as NaN
        and stays so; the others go on.
        """
