"""The check of a log before a training, as check.py does it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pinn_dyn.app.config import checked
from pinn_dyn.data import LogSource
from pinn_dyn.log_check.check import LogCheck
from pinn_dyn.log_check.check import check as check_log
from pinn_dyn.log_check.structure import SCALE
from pinn_dyn.models.structure import Structure
from pinn_dyn.run.configuration.build import ConfigError, build_part, build_source, naming
from pinn_dyn.run.configuration.command_line import command_line
from pinn_dyn.run.run_folder import write_config
from pinn_dyn.run.training.known_data import joints_of, match_structure
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
    if not report.problems:
        _print_commands(report, structure)
    if report.problems:
        raise ConfigError(
            f"{source.name}: the log is not suitable for training: {'; '.join(report.problems)}"
        )


def _print_commands(report: LogCheck, structure: Structure | None) -> None:
    """Print the commands of a training on this data set."""
    if structure is not None:
        options = [x for x in report.candidates[0][1] if "friction" not in x]  # the default
        options = [x for x in options if not x.startswith("model=")]
        options += _gains(report, structure) if "model/input=servo" not in options else []
        print(f"a training of its constants: {_training(['experiment=known', *options], True)}")
        return
    for reason, options in report.candidates:
        print(f"a training, {reason}: {_training(options)}")
        if "experiment=oscillators" in options:
            print("the modes, a control law and C code follow: docs/soft_robots.md")
        elif "model=lnn" in options:
            text = "with a URDF, model=known with these options is often better:"
            print(f"{text} docs/known_mechanics.md")


def _gains(report: LogCheck, structure: Structure) -> list[str]:
    """Return the options for the joints that the inputs drive, and for inputs that are no forces.

    The gains are those that the masses of the URDF suggest. A joint without a clear one gets the
    median gain.
    """
    names, units = getattr(structure, "joint_names", []), report.source.u.units
    options = []
    if report.driven and isinstance(structure, RigidChain):
        driven = joints_of(report.source.u.columns, names) or [names[k] for k in report.driven]
        if len(set(driven)) == len(driven):
            options.append(f"model.driven_joints=[{','.join(driven)}]")
    if set(units) <= {"Nm", "N"}:
        return options
    scales = {x.place: x.value for x in report.measurements if x.name == SCALE and x.value > 0}
    usual = 1 / float(np.median([*scales.values()])) if scales else 10.0
    driven = [names[k] for k in report.driven] or names[: len(units)]
    gains = [1 / scales[x] if x in scales else usual for x in driven]
    values = ",".join(f"{gain:.2g}" for gain in gains)
    return [*options, f"model.drive_gain=[{values}]", "model.gain_spread=0.5"]


def _training(options: Sequence[str], with_structure: bool = False) -> str:
    """Return the command that trains a model on this data set, for a shell.

    The command identifies the structure that the check was called with, if ``with_structure``.
    """
    parts = shlex.split(command_line())
    program = Path(parts.pop(parts[0] == "python"))  # after the name of the interpreter
    dropped = ("hydra.", "longest_delay=") + (() if with_structure else ("model",))
    parts = [x for x in parts if not x.startswith(dropped)]
    name = program.with_name(program.name.replace("check", "train"))
    parts.insert(parts[:1] == ["python"], str(name))
    if not any(x.startswith("dataset=") for x in parts):
        parts.append(f"dataset={HydraConfig.get().runtime.choices['dataset']}")
    return shlex.join([*parts, *options])
