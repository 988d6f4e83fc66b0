"""Compose the configuration of a command without checking it."""

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from pinn_dyn.app.config import config_folder

REQUIRED = {
    "train": [],
    "evaluate": ["runs=[x]"],
    "control": ["run=x", "reference.q=[0,0,0]"],
    "gather": ["runs=[x]"],
    "check": [],
    "excite": ["model.structure.urdf=x"],
}


def compose(command, *overrides):
    folder = str(config_folder(command))
    with hydra.initialize_config_dir(version_base="1.3", config_dir=folder):
        required = REQUIRED[command][: None if not overrides else 1]  # experiments have references
        cfg = hydra.compose(command, overrides=[*required, *overrides], return_hydra_config=True)
    HydraConfig.instance().set_config(cfg)
    OmegaConf.set_struct(cfg, False)
    if command == "train":
        cfg.model_name = cfg.hydra.runtime.choices.model
    del cfg["hydra"]
    return cfg
