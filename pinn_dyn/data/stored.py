"""Trajectories in a file: the data of a run whose source was made in Python."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pinn_dyn.data.source import SPLITS, DataSource, Splits
from pinn_dyn.data.whole import whole
from pinn_dyn.mechanics import Signal, Trajectory


class StoredSource(DataSource):
    """Trajectories that another data source left in a file, see :func:`store`.

    They have no momenta and no true system, since a file holds no code.

    Args:
        path: the file, as written by :func:`store`.
        name, labels, input_labels, angles: as in the other source.

    Raises:
        ValueError: if the file is missing or damaged, when it is read.
    """

    def __init__(
        self,
        path: str,
        name: str,
        labels: Sequence[str],
        input_labels: Sequence[str],
        angles: Sequence[int] = (),
    ):
        self.path = Path(path).expanduser()
        self.name = name
        self.labels = list(labels)
        self.input_labels = list(input_labels)
        self.angles = tuple(angles)

    def load(self) -> Splits:
        arrays = self._read()
        return Splits(**{split: _unpack(split, arrays) for split in SPLITS})

    def names(self) -> dict[str, list[str]]:
        arrays = self._read()
        return {split: arrays[f"{split}_names"].tolist() for split in SPLITS}

    def _read(self) -> dict[str, np.ndarray]:
        try:
            with np.load(self.path, allow_pickle=False) as file:
                return dict(file)
        except (OSError, ValueError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"{self.path}, the data that the run was trained on, cannot be read: {error}"
            ) from error


def store(source: DataSource, path: Path) -> None:
    """Write the trajectories of a source to a file."""
    arrays: dict[str, Any] = {}
    splits, names = source.load(), source.names()
    for split in SPLITS:
        trajectories: list[Trajectory] = getattr(splits, split)
        arrays[split] = [item.input.interpolation for item in trajectories]
        arrays[f"{split}_names"] = names[split]
        for k, item in enumerate(trajectories):
            values = {"t": item.t, "q": item.q, "v": item.v, "u": item.u, "past": item.past}
            for key, value in values.items():
                if value is not None:
                    arrays[f"{split}_{k}_{key}"] = value.numpy()
    with whole(path) as partial, partial.open("wb") as file:
        np.savez(file, **arrays)


def _unpack(split: str, arrays: dict[str, np.ndarray]) -> list[Trajectory]:
    trajectories = []
    for k, interpolation in enumerate(arrays[split].tolist()):
        q, v, u, t = (torch.from_numpy(arrays[f"{split}_{k}_{key}"]) for key in "qvut")
        past = arrays.get(f"{split}_{k}_past")
        trajectories.append(
            Trajectory(
                q,
                v,
                Signal(t, u, interpolation),
                past=None if past is None else torch.from_numpy(past),
            )
        )
    return trajectories
