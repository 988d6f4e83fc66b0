"""Checkpoints that are whole or absent, whenever a training is killed."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import TorchCheckpointIO

from pinn_dyn.data.whole import whole


class WholeCheckpoints(TorchCheckpointIO):
    """Writes a file beside the checkpoint and moves it into place.

    Lightning itself writes to the folder of temporary files and moves the file from there, which
    is no single step where that is another file system.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write a checkpoint, replacing the one of that name."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        content = io.BytesIO()  # torch.save itself says nothing of a full disk
        torch.save(checkpoint, content)
        with whole(path) as partial, partial.open("wb") as file:
            file.write(content.getbuffer())
            file.flush()
            os.fsync(file.fileno())
