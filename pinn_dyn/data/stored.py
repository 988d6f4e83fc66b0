"""Trajectories in a file: the data of a run whose source was made in Python."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pinn_dyn.data.source import SPLITS, DataSource, Splits
from pinn_dyn.data.whole import whole
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.mechanics.signal import Interpolation


@dataclass(eq=False)
class StoredSource(DataSource):
    """Trajectories that :func:`store` wrote to a file, without momenta and true system.

    Args:
        path: the file.
        name, labels, input_labels, angles: as in the stored source.

    Raises:
        ValueError: if the file is missing or damaged, when it is read.
    """

    path: str
    name: str
    labels: list[str]
    input_labels: list[str]
    angles: Sequence[int] = ()

    def load(self) -> Splits:
        arrays = self._read()

        def unpack(split: str, k: int, interpolation: Interpolation) -> Trajectory:
            keys = {key: f"{split}_{k}_{key}" for key in ("t", "q", "v", "u", "past")}
            item = {k: torch.from_numpy(arrays[name]) for k, name in keys.items() if name in arrays}
            signal = Signal(item["t"], item["u"], interpolation)
            return Trajectory(item["q"], item["v"], signal, past=item.get("past"))

        return Splits(
            **{
                split: [unpack(split, k, kind) for k, kind in enumerate(arrays[split].tolist())]
                for split in SPLITS
            }
        )

    def names(self) -> dict[str, list[str]]:
        arrays = self._read()
        return {split: arrays[f"{split}_names"].tolist() for split in SPLITS}

    def _read(self) -> dict[str, np.ndarray]:
        try:
            with np.load(Path(self.path).expanduser(), allow_pickle=False) as file:
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
