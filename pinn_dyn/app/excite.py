"""The command excite.py: design a motion for the identification of a rigid robot."""

from __future__ import annotations

from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pinn_dyn.app.config import checked
from pinn_dyn.identification.excitation_design import design_excitation
from pinn_dyn.run.configuration.build import ConfigError, build_part
from pinn_dyn.run.run_folder import write_config


def excite(cfg: DictConfig) -> None:
    """Design a motion, print the use of its limits, and write the files for the robot."""
    config = checked("excite", cfg)
    robot = build_part("model.structure", config["model"]["structure"])
    keys = ("limits", "duration", "frequency", "start", "steps", "seed")
    try:
        motion = design_excitation(robot, **{key: config[key] for key in keys})
    except ValueError as error:
        raise ConfigError(str(error)) from error
    folder = Path(HydraConfig.get().runtime.output_dir)
    write_config(folder, config)
    motion.save(folder, config["rate"], config["approach"])
    print(f"\n{motion}\nself-collisions are not checked\n\nthe motion is in {folder}")
