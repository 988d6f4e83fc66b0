"""The three contracts of a control loop: reference, controller and plant."""

from __future__ import annotations

import abc
from typing import NamedTuple

from torch import Tensor


class Motion(NamedTuple):
    """Desired configuration q, velocity v and acceleration a at one time, ``(*batch, N)`` each."""

    q: Tensor
    v: Tensor
    a: Tensor


class Reference(abc.ABC):
    """A desired motion q_ref(t) with its exact first and second derivatives."""

    num_coordinates: int

    @abc.abstractmethod
    def __call__(self, t: float) -> Motion:
        """Return the desired motion at time t in s, ``(N,)`` each or ``(K, N)`` for K runs."""


class Controller(abc.ABC):
    """A control law u = u(t, q, v, reference) with N coordinates and M inputs, batched."""

    def __init__(self, num_coordinates: int, num_inputs: int):
        self.num_coordinates = num_coordinates
        self.num_inputs = num_inputs

    def reset(self) -> None:  # noqa: B027 - most laws have no memory
        """Forget the past, before a new run."""

    def follow(self, reference: Reference) -> None:  # noqa: B027 - most laws do not look ahead
        """Store the reference of a new run, for laws that look ahead."""

    @abc.abstractmethod
    def __call__(self, t: float, q: Tensor, v: Tensor, reference: Motion) -> Tensor:
        """Return u ``(*batch, M)`` at time t in s, from the measured q and v ``(*batch, N)``."""

    def diagnostics(self) -> dict[str, Tensor]:
        """Return named numbers about the latest call for the record, ``(*batch,)`` each."""
        return {}

    def faults(self) -> dict[str, Tensor]:
        """Return reasons to stop after the latest call, each with its mask ``(*batch,)``."""
        return {}


class Plant(abc.ABC):
    """K copies of a robot with N coordinates and M inputs, started and moved together."""

    num_coordinates: int
    num_inputs: int

    @abc.abstractmethod
    def start(self, q0: Tensor, v0: Tensor) -> None:
        """Put the K copies into their initial states, ``(K, N)`` each."""

    @abc.abstractmethod
    def advance(self, u: Tensor, duration: float) -> tuple[Tensor, Tensor]:
        """Hold the input u ``(K, M)`` for a time in s; return q and v after it, ``(K, N)`` each.

        A copy that diverges becomes NaN and stays so, and does not affect the other copies.
        """
