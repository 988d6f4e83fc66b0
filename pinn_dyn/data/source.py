"""The contract of a data set: whole trajectories for training, validation and test."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from pinn_dyn.atomic_files import whole
from pinn_dyn.mechanics import MechanicalSystem, Signal, Trajectory

SPLITS = ("train", "validation", "test")


@dataclass(frozen=True)
class Splits:
    """Trajectories for training, validation and test. No trajectory is in two splits."""

    train: list[Trajectory]
    validation: list[Trajectory]
    test: list[Trajectory]


class DataSource(abc.ABC):
    """Source of trajectories: a simulation, a log, or a user-defined class with :meth:`load`.

    Attributes:
        name: short name, for tables and titles.
        labels: name and unit of each coordinate, N.
        input_labels: name and unit of each input, M.
        angles: indices of the coordinates that repeat after a full turn.
        system: the ground truth, or None for measured data.
        configurations: named configurations at which learned terms are evaluated, ``(N,)`` each.
        delay: dead time of the robot's inputs, s, one number or M. The trajectories hold the inputs
            at the times at which they act.
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
        """Dead time of each input, ``(M,)``, s."""
        return np.resize(np.asarray(self.delay, dtype=float), len(self.input_labels))

    @abc.abstractmethod
    def load(self) -> Splits:
        """Return the trajectories. A second call reads them from the cache."""

    def names(self) -> dict[str, list[str]]:
        """Return the names of the trajectories of each split. By default, they are numbered."""
        names = {}
        for split, trajectories in vars(self.load()).items():
            names[split] = [f"{split} trajectory {k}" for k in range(len(trajectories))]
        return names


@dataclass(eq=False)
class StoredSource(DataSource):
    """Trajectories from a file of :func:`store`, without momenta and ground truth.

    Args:
        path: the file.
        name, labels, input_labels, angles, delay: attributes of the stored source.

    Raises:
        ValueError: if the file is missing or damaged, when it is read.
    """

    path: str
    name: str
    labels: list[str]
    input_labels: list[str]
    angles: Sequence[int] = ()
    delay: float | Sequence[float] = 0.0

    def load(self) -> Splits:
        content = self._read()

        def unpack(t: Any, q: Any, v: Any, u: Any, interpolation: Any, **past: Any) -> Trajectory:
            return Trajectory(q, v, Signal(t, u, interpolation), **past)

        return Splits(*([unpack(**item) for item in content[split]] for split in SPLITS))

    def names(self) -> dict[str, list[str]]:
        names: dict[str, list[str]] = self._read()["names"]
        return names

    def _read(self) -> dict[str, Any]:
        path = Path(self.path).expanduser()
        try:
            if path.exists() and not path.is_file():  # opening a pipe would wait
                raise ValueError("it is not a regular file")
            content: dict[str, Any] = torch.load(path, weights_only=True)
        except Exception as error:  # a damaged file raises nearly anything
            raise ValueError(
                f"{self.path}, the data that the run was trained on, cannot be read: {error}"
            ) from error
        return content


def store(source: DataSource, path: Path) -> None:
    """Write the trajectories of a source to a file."""
    content: dict[str, Any] = {"names": source.names()}
    for split, trajectories in vars(source.load()).items():
        content[split] = [
            {
                **{key: getattr(x, key).clone() for key in "tqvu"},
                "past": x.past,
                "past_q": x.past_q,
                "interpolation": x.input.interpolation,
            }
            for x in trajectories
        ]
    with whole(path) as partial:
        torch.save(content, partial)
