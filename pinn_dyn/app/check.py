"""The check of a log before a training, as check.py does it."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pinn_dyn.app.config import checked
from pinn_dyn.data import LogSource
from pinn_dyn.log_check.check import LogCheck
from pinn_dyn.log_check.check import check as check_log
from pinn_dyn.log_check.structure import SCALE
from pinn_dyn.run.build import ConfigError, build_part, build_source, naming
from pinn_dyn.run.known_data import match_structure
from pinn_dyn.run.program import command_line
from pinn_dyn.run.run_folder import write_config
from pinn_dyn.systems import RigidChain


def check(cfg: DictConfig) -> None:
    """Print the measurements of a log, write a page, and refuse a log that cannot be used."""
    config = checked("check", cfg)
    source = build_source(config)
    if not isinstance(source, LogSource):
        raise ConfigError(
            f"dataset {source.name} is simulated, expected a log, such as dataset=example_log"
        )
    structure = None
    if (part := config["model"]["structure"]) is not None:
        structure = build_part("model.structure", part)
        if isinstance(structure, RigidChain):
            structure = match_structure(structure, source)
    with naming(source.name):
        report = check_log(source, longest_delay=config["longest_delay"], structure=structure)
    folder = Path(HydraConfig.get().runtime.output_dir)
    write_config(folder, config)
    print(f"\n{report}\n\nthe page is {report.save(folder, command_line())}")
    if structure is not None:
        options = [option for option in report.options if "friction" not in option]  # the default
        options += _gains(report) if "model/input=servo" not in options else []
        print(f"a training of its constants: {_training(options, True)}")
    elif report.options and report.model == "oscillators":
        print(f"a training: {_training(report.options)}")
        print("the modes, a control law and C code follow: docs/soft_robots.md")
    elif report.options:
        names = {"model/input=servo": "targets of servos", "model/friction=coulomb": "dry friction"}
        effects = " and ".join(names[option] for option in report.options if option in names)
        print(f"a training with {effects}: {_training(report.options)}")
        print(
            "with a URDF, model=known with these options is often better: docs/known_mechanics.md"
        )
    if report.problems:
        raise ConfigError(f"{source.name}: a training makes no sense: {'; '.join(report.problems)}")


def _gains(report: LogCheck) -> list[str]:
    """Return the options for inputs that are no forces, with the gains that the URDF suggests."""
    units = report.source.u.units
    if set(units) <= {"Nm", "N"}:
        return []
    scales = np.array([x.value for x in report.measurements if x.name == SCALE])
    clear = scales[scales > 0]
    usual = 1 / float(np.median(clear)) if len(clear) else 10.0
    gains = [1 / x if x > 0 else usual for x in scales.tolist()] or [usual] * len(units)
    values = ",".join(f"{gain:.2g}" for gain in gains)
    return [f"model.drive_gain=[{values}]", "model.gain_spread=0.5"]


def _training(options: list[str], with_structure: bool = False) -> str:
    """Return the command that trains a model on this data set, for a shell.

    The command identifies the structure that the check was called with, if ``with_structure``.
    """
    parts = shlex.split(command_line())
    program = Path(parts.pop(parts[0] == "python"))  # behind the name of the interpreter
    dropped = ("hydra.", "longest_delay=") + (() if with_structure else ("model",))
    parts = [x for x in parts if not x.startswith(dropped)]
    name = program.with_name(program.name.replace("check", "train"))
    parts.insert(parts[:1] == ["python"], str(name))
    if not any(x.startswith("dataset=") for x in parts):
        parts.append(f"dataset={HydraConfig.get().runtime.choices['dataset']}")
    if with_structure:
        options = ["experiment=known", *options]
    elif "experiment=oscillators" not in options:
        options = ["model=lnn", *options]
    return shlex.join([*parts, *options])
