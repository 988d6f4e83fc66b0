"""Trajectories in a file: what a data source that Python made leaves in its run folder."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pinn_dyn.data.source import SPLITS, DataSource, Splits
from pinn_dyn.data.whole import whole
from pinn_dyn.mechanics import Signal, Trajectory

_FINGERPRINT = "fingerprint"


class StoredSource(DataSource):
    """The trajectories of another data source, from a file that :func:`store` wrote.

    They have no momenta and no true system, as a file holds no code.

    Args:
        path: the file.
        name, labels, input_labels, angles: as of the other source.

    Raises:
        ValueError: if there is no such file, or it does not hold what :func:`store` writes.
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
        if not self.path.is_file():
            raise ValueError(
                f"{name}: {self.path} does not exist, expected the trajectories that the run was "
                "trained on: if its folder was moved, mend dataset.path in its config.yaml"
            )

    def load(self) -> Splits:
        arrays = self._read()
        try:
            splits = {split: _unpacked(split, arrays) for split in SPLITS}
        except (KeyError, IndexError) as error:
            raise ValueError(f"{self.path} lacks {error}: it may be damaged") from error
        return Splits(**splits)

    def fingerprint(self) -> dict[str, object]:
        """That of the other source."""
        text = str(self._read()[_FINGERPRINT])
        found: dict[str, object] = json.loads(text)
        return found

    def _read(self) -> dict[str, np.ndarray]:
        try:
            with np.load(self.path, allow_pickle=False) as file:
                return dict(file)
        except (OSError, ValueError, zipfile.BadZipFile) as error:
            raise ValueError(f"{self.path} cannot be read, it may be damaged: {error}") from error


def store(source: DataSource, path: Path) -> dict[str, Any]:
    """Write the trajectories of a source; returns the configuration that reads them.

    Args:
        source: any data source.
        path: the file, in a folder that exists.

    Raises:
        OSError: where it cannot be written.
    """
    arrays: dict[str, Any] = {_FINGERPRINT: json.dumps(source.fingerprint())}
    splits = source.load()
    for split in SPLITS:
        trajectories: list[Trajectory] = getattr(splits, split)
        arrays[split] = [item.input.interpolation for item in trajectories]
        for k, item in enumerate(trajectories):
            values = {"t": item.t, "q": item.q, "v": item.v, "u": item.u, "past": item.past}
            for key, value in values.items():
                if value is not None:
                    arrays[f"{split}_{k}_{key}"] = value.numpy()
    with whole(path) as partial, partial.open("wb") as file:
        np.savez(file, **arrays)
    return {
        "_target_": "pinn_dyn.data.StoredSource",
        "path": str(path),
        "name": source.name,
        "labels": list(source.labels),
        "input_labels": list(source.input_labels),
        "angles": list(source.angles),
    }


def _unpacked(split: str, arrays: dict[str, np.ndarray]) -> list[Trajectory]:
    made = []
    for k, interpolation in enumerate(arrays[split].tolist()):
        q, v, u, t = (torch.from_numpy(arrays[f"{split}_{k}_{key}"]) for key in "qvut")
        past = arrays.get(f"{split}_{k}_past")
        made.append(
            Trajectory(
                q,
                v,
                Signal(t, u, interpolation),
                past=None if past is None else torch.from_numpy(past),
            )
        )
    return made
