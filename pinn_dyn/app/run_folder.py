"""Run folders: their layout, whose they are, and how a trained model is loaded back."""

from __future__ import annotations

import contextlib
import glob
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from filelock import FileLock, Timeout

from pinn_dyn.app.build import CHECKPOINTS, build_predictor
from pinn_dyn.app.config import ConfigError
from pinn_dyn.evaluation.sweep_table import flatten
from pinn_dyn.mechanics import Predictor
from pinn_dyn.models import Statistics

CONFIG = "config.yaml"
METRICS = "metrics.json"

_PLACES = ("dataset.cache",)  # where things lie does not change what is learned


@dataclass(frozen=True)
class Run:
    """A trained model with its resolved configuration, scales and recorded metrics."""

    folder: Path
    config: dict[str, Any]
    model: Predictor
    statistics: Statistics
    metrics: dict[str, Any]


def write_config(folder: Path, config: dict[str, Any]) -> None:
    """Write the resolved configuration of a run."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CONFIG).write_text(yaml.safe_dump(config, sort_keys=False, allow_unicode=True))


def read_config(folder: Path) -> dict[str, Any]:
    """The resolved configuration of a run.

    Raises:
        ConfigError: if the folder is no run folder.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise ConfigError(
            f"{folder} is not a run folder: it has no {CONFIG}. A run folder is what train.py "
            "writes, such as runs/soft_arm_1/hnn-seed0/<date>"
        )
    return yaml.safe_load(path.read_text())


def load_run(folder: Path, checkpoint: str) -> Run:
    """Load a run's model from one of its checkpoints, ``best`` or ``last``.

    Raises:
        ConfigError: if the folder is no run folder, the checkpoint is missing or damaged, or it
            belongs to another model than the configuration says.
    """
    config = read_config(folder)
    path = folder / CHECKPOINTS / f"{checkpoint}.ckpt"
    if not path.is_file():
        found = sorted(p.stem for p in path.parent.glob("*.ckpt"))
        raise ConfigError(
            f"{path} does not exist; {path.parent} has {', '.join(found) or 'no checkpoint'}"
        )
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged archive or pickle raises nearly anything
        raise ConfigError(f"{path} cannot be read, it may be cut short: {error}") from error
    parameters = saved["hyper_parameters"]
    statistics = Statistics.from_dict(parameters["statistics"])
    model = build_predictor(config, statistics)
    weights = {
        key.removeprefix("model."): value
        for key, value in saved["state_dict"].items()
        if key.startswith("model.")
    }
    written_for = parameters["config"]["model"]
    try:
        if written_for != config["model"]:
            raise RuntimeError("their model sections differ")
        model.load_state_dict(weights)
    except RuntimeError as error:
        raise ConfigError(
            f"{path} holds weights of another model than {folder / CONFIG} describes "
            f"({config['model']['_target_']}, the checkpoint was written for "
            f"{written_for['_target_']}): {error}"
        ) from error
    path = folder / METRICS
    metrics = json.loads(path.read_text()) if path.is_file() else {}
    return Run(folder, config, model.eval(), statistics, metrics)


def find_runs(patterns: list[str] | str) -> list[Path]:
    """Run folders that match paths or globs; folders without a config are passed over in globs.

    Raises:
        ConfigError: if a pattern matches nothing, or a plain path is no run folder.
    """
    found: list[Path] = []
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        matches = sorted(Path(p) for p in glob.glob(os.path.expanduser(pattern)))
        folders = [p for p in matches if (p / CONFIG).is_file()]
        if not folders:
            what = "matches nothing" if not matches else f"matches no run folder (no {CONFIG})"
            raise ConfigError(f"runs: '{pattern}' {what}; give folders that train.py wrote")
        found += [p for p in folders if p not in found]
    return found


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
