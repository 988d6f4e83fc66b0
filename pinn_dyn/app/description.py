"""What the loggers are told about a run: the settings that tell it from others."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from pinn_dyn.app.runs import CONFIG, provenance
from pinn_dyn.evaluation import RunDescription
from pinn_dyn.evaluation.sweep_table import Cell, flatten

_OVERRIDES = Path(".hydra") / "overrides.yaml"

# Compared among all runs, chosen on the command line or not.
_ALWAYS = (
    "seed",
    "data.pairs",
    "data.steps",
    "data.stride",
    "data.batch_size",
    "optimizer.lr",
    "trainer.max_epochs",
)
# Not about what is learned.
_IGNORED = ("callbacks", "logger", "name", "model_name", "threads", "resume", "search")


def describe(folder: Path, config: dict[str, Any]) -> RunDescription:
    """The description of the run in a folder."""
    path = folder / _OVERRIDES
    overrides = yaml.safe_load(path.read_text()) if path.is_file() else []
    return RunDescription(
        settings=run_settings(config, overrides),
        configuration=(folder / CONFIG).read_text(),
        provenance=provenance(),
    )


def run_settings(config: dict[str, Any], overrides: list[str]) -> dict[str, Cell]:
    """The settings to compare with those of other runs.

    The whole configuration has some hundred values that hardly ever differ. So these are: model,
    data set, the usual ones, and every value or group that was given on the command line, in a
    sweep too, such as ``model.integrator.substeps=2`` and ``model/damping=constant``.
    """
    flat = flatten(config)
    settings = {
        "model": flat["model_name"],
        "dataset": flat["dataset.name"],
        "loss": flat["loss._target_"],
        **{key: flat[key] for key in _ALWAYS if key in flat},
    }
    for override in overrides:
        key, _, value = override.lstrip("+").partition("=")
        if not key.startswith("~") and key.split(".")[0] not in _IGNORED:
            settings.setdefault(key, flat.get(key, value))
    return settings
