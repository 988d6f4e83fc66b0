"""A run folder holds one training: whose it is, and whether it is done."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.runs import CHECKPOINTS, METRICS, read_config, write_config
from pinn_dyn.evaluation.sweep_table import flatten

_PLACES = ("dataset.cache",)  # where things lie does not change what is learned


@contextlib.contextmanager
def claimed(folder: Path, config: dict[str, Any]) -> Iterator[None]:
    """Work in a run folder, alone in it and with the configuration that it was made for.

    Raises:
        ConfigError: if another process works there, or the folder was made for another
            configuration; it names the keys that differ.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / ".lock", timeout=0):
            # A training that failed before its first checkpoint leaves nothing to be mixed up.
            if (folder / METRICS).is_file() or (folder / CHECKPOINTS / "last.ckpt").is_file():
                _refuse_another(folder, config)
            else:
                write_config(folder, config)
            yield
    except Timeout as error:
        raise ConfigError(f"{folder} is in use: another process trains there") from error


def _refuse_another(folder: Path, config: dict[str, Any]) -> None:
    here, there = flatten(config), flatten(read_config(folder))
    differing = [
        f"{key}={here.get(key, 'absent')} (there {there.get(key, 'absent')})"
        for key in dict.fromkeys([*here, *there])
        if here.get(key) != there.get(key) and key not in _PLACES
    ]
    if differing:
        shown = differing[:5] + (["..."] if len(differing) > 5 else [])
        raise ConfigError(
            f"{folder} holds a training of another configuration: {', '.join(shown)}; choose "
            "another folder, or delete this one"
        )


def recorded_error(folder: Path) -> float | None:
    """The validation error that a finished training recorded; None if it has not finished."""
    path = folder / METRICS
    if not path.is_file():
        return None
    return json.loads(path.read_text())["validation"].get("val/error_mean", float("nan"))
