"""The contract of a data set: trajectories, split by whole trajectories."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from pinn_dyn.mechanics import MechanicalSystem, Trajectory

SPLITS = ("train", "validation", "test")


@dataclass(frozen=True)
class Splits:
    """Trajectories for training, validation and test; no trajectory is in two of them.

    Attributes:
        train, validation, test: the trajectories.
    """

    train: list[Trajectory]
    validation: list[Trajectory]
    test: list[Trajectory]


class DataSource(abc.ABC):
    """Where trajectories come from: a simulation, a log, or a class of your own.

    A source of your own sets the attributes and gives :meth:`load`; the rest has defaults.

    Attributes:
        name: short name, for tables and titles.
        labels: name and unit of each coordinate, N.
        input_labels: name and unit of each input, M.
        angles: numbers of the coordinates that are angles of joints: the robot is the same after a
            whole turn.
        system: the truth, or None for measured data.
        configurations: named configurations at which learned terms are looked at, ``(N,)`` each.
    """

    name: str
    labels: list[str]
    input_labels: list[str]
    angles: Sequence[int] = ()
    system: MechanicalSystem | None = None
    configurations: Mapping[str, Sequence[float]] = MappingProxyType({})

    @abc.abstractmethod
    def load(self) -> Splits:
        """The trajectories; a second call, or a second process, reads them from the cache."""

    def names(self) -> dict[str, list[str]]:
        """Return the names of the trajectories of each split, for messages.

        A log gives the names of its runs; the default numbers the trajectories.
        """
        splits = self.load()
        return {
            split: [f"{split} trajectory {k}" for k in range(len(getattr(splits, split)))]
            for split in SPLITS
        }
