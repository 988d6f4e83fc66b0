"""Trajectories in a file: the data of a run whose source was made in Python."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from pinn_dyn.data.source import SPLITS, DataSource, Splits
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.whole import whole


@dataclass(eq=False)
class StoredSource(DataSource):
    """Trajectories that :func:`store` wrote to a file, without momenta and true system.

    Args:
        path: the file.
        name, labels, input_labels, angles, delay: as in the stored source.

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

        return Splits(**{split: [unpack(**item) for item in content[split]] for split in SPLITS})

    def names(self) -> dict[str, list[str]]:
        names: dict[str, list[str]] = self._read()["names"]
        return names

    def _read(self) -> dict[str, Any]:
        path = Path(self.path).expanduser()
        try:
            if path.exists() and not path.is_file():  # opening a pipe would wait
                raise ValueError("it is no regular file")
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
