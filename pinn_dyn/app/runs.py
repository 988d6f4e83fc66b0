"""Run folders: what a training leaves behind, and how it is loaded back."""

from __future__ import annotations

import glob
import json
import os
import platform
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml

from pinn_dyn.app.build import CHECKPOINTS, build_predictor
from pinn_dyn.app.config import ConfigError
from pinn_dyn.mechanics import Predictor
from pinn_dyn.models import Statistics

CONFIG = "config.yaml"
METRICS = "metrics.json"


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


def provenance() -> dict[str, str]:
    """Commit, whether tracked files differ from it, software and hardware, for the records."""
    commit = _git("rev-parse", "--short", "HEAD")
    changed = _git("status", "--porcelain", "--untracked-files=no")
    return {
        "commit": commit or "unknown",
        "uncommitted_changes": "unknown" if not commit else "yes" if changed else "no",
        "torch": torch.__version__,
        "python": platform.python_version(),
        "hardware": f"{_processor()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads",
    }


def _git(*arguments: str) -> str:
    """What git says of the code; nothing where there is no repository."""
    command = ["git", "-C", str(Path(__file__).parent), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(x.split(":")[1].strip() for x in lines if x.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
