"""The contract of a data set: trajectories, split by whole trajectories."""

from __future__ import annotations

import abc
from dataclasses import dataclass

from pinn_dyn.mechanics import MechanicalSystem, Trajectory


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
    """Where trajectories come from: a simulation or a log.

    Attributes:
        name: short name, for tables and titles.
        labels: name and unit of each coordinate.
        input_labels: name and unit of each input.
        system: the truth, or None for measured data.
        configurations: named configurations at which learned terms are looked at, ``(N,)`` each.
    """

    name: str
    labels: list[str]
    input_labels: list[str]
    system: MechanicalSystem | None
    configurations: dict[str, list[float]]

    @abc.abstractmethod
    def load(self) -> Splits:
        """The trajectories; a second call, or a second process, reads them from the cache."""
