"""Atomic checkpoint writes, so that a killed training leaves no partial file."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import TorchCheckpointIO

from pinn_dyn.data.whole import whole


class WholeCheckpoints(TorchCheckpointIO):
    """Checkpoint writer that writes a file next to the checkpoint and renames it."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write a checkpoint, and replace an existing one."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        content = io.BytesIO()  # torch.save itself says nothing of a full disk
        torch.save(checkpoint, content)
        with whole(path) as partial, partial.open("wb") as file:
            file.write(content.getbuffer())
            file.flush()
            os.fsync(file.fileno())
