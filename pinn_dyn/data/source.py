"""The contract of a data set: trajectories, split by whole trajectories."""

from __future__ import annotations

import abc
import hashlib
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

    def fingerprint(self) -> dict[str, object]:
        """What tells these data from any other, JSON-serializable; here of the numbers themselves.

        It does not change from one call, or one process, to the next. Two of them are compared by
        :func:`~pinn_dyn.data.fingerprint_changes`.
        """
        splits = self.load()
        hashes: dict[str, object] = {}
        for split in SPLITS:
            content = hashlib.sha256()
            trajectories: list[Trajectory] = getattr(splits, split)
            for item in trajectories:
                for value in (item.t, item.q, item.v, item.u):
                    content.update(str(tuple(value.shape)).encode() + value.numpy().tobytes())
            hashes[split] = {"trajectories": len(trajectories), "sha256": content.hexdigest()}
        return {"class": type(self).__name__, **hashes}
