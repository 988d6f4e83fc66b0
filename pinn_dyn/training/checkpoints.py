"""Atomic checkpoint writes, so that a killed training leaves no partial file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightning.fabric.plugins import TorchCheckpointIO

from pinn_dyn.whole import save_whole


class WholeCheckpoints(TorchCheckpointIO):
    """Checkpoint writer that writes a file next to the checkpoint and renames it."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write a checkpoint, and replace an existing one."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_whole(path, checkpoint)
