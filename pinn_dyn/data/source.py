"""The contract of a data set: trajectories, split by whole trajectories."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from pinn_dyn.mechanics import MechanicalSystem, Trajectory

SPLITS = ("train", "validation", "test")


@dataclass(frozen=True)
class Splits:
    """Trajectories for training, validation and test; no trajectory is in two of them."""

    train: list[Trajectory]
    validation: list[Trajectory]
    test: list[Trajectory]


class DataSource(abc.ABC):
    """Source of trajectories: a simulation, a log, or a class of your own with :meth:`load`.

    Attributes:
        name: short name, for tables and titles.
        labels: name and unit of each coordinate, N.
        input_labels: name and unit of each input, M.
        angles: indices of the coordinates that repeat after a whole turn.
        system: the truth, or None for measured data.
        configurations: named configurations at which learned terms are looked at, ``(N,)`` each.
        delay: time by which the inputs of the robot act late, s, one or M. The trajectories hold
            the inputs as they act.
    """

    name: str
    labels: list[str]
    input_labels: list[str]
    angles: Sequence[int] = ()
    system: MechanicalSystem | None = None
    configurations: Mapping[str, Sequence[float]] = MappingProxyType({})
    delay: float | Sequence[float] = 0.0

    @property
    def input_delay(self) -> np.ndarray:
        """Time between an input of the robot and its action, ``(M,)``, s."""
        return np.resize(np.asarray(self.delay, dtype=float), len(self.input_labels))

    @abc.abstractmethod
    def load(self) -> Splits:
        """Return the trajectories; a second call reads them from the cache."""

    def names(self) -> dict[str, list[str]]:
        """Return the names of the trajectories of each split; the default numbers them."""
        splits = self.load()
        return {
            split: [f"{split} trajectory {k}" for k in range(len(getattr(splits, split)))]
            for split in SPLITS
        }
