"""Parts of a training by the configuration of train.py, for the benchmarks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning as L
import torch

from pinn_dyn.data import DataSource, DynamicsData
from pinn_dyn.evaluation import RolloutValidator
from pinn_dyn.mechanics import Predictor
from pinn_dyn.models import Statistics
from pinn_dyn.run.configuration.build import build_part, build_source, model_builder
from pinn_dyn.run.training import prepared, trainer
from pinn_dyn.training import DynamicsLearner


def build_data(config: dict[str, Any], source: DataSource | None = None) -> DynamicsData:
    """Build the windows of a configuration, on a source or else that of the configuration."""
    batches = trainer.epochs(config["trainer"]["steps"], config["trainer"]["validations"])[1]
    builder = build_part("data", config["data"], partial_=True)
    return prepared.build_data(builder, source or build_source(config), config["seed"], batches)


def build_model(config: dict[str, Any], statistics: Statistics) -> Predictor:
    """Build the model of a configuration, scaled to the data."""
    torch.manual_seed(config["seed"])
    return model_builder(config)(statistics=statistics)


def build_validator(config: dict[str, Any], step: float) -> RolloutValidator:
    """Build the validator of a configuration."""
    return build_part("validator", config["validator"], training_step=step)


def build_learner(
    config: dict[str, Any], model: Predictor, statistics: Statistics, validator: RolloutValidator
) -> DynamicsLearner:
    """Build the LightningModule of a configuration."""
    parts = ("loss", "optimizer", "scheduler")
    settings = config["trainer"]
    return trainer.build_learner(
        model,
        statistics,
        validator,
        **{name: build_part(name, config[name], partial_=True) for name in parts},
        config=config,
        compile=trainer.compiles(config["compile"], settings["steps"], settings),
        clipping={k: x for k, x in settings.items() if k.startswith("gradient_clip")},
    )


def build_trainer(config: dict[str, Any], folder: Path) -> L.Trainer:
    """Build the trainer of a configuration, with a TensorBoard log."""
    settings = {k: x for k, x in config["trainer"].items() if not k.startswith("_")}
    length = trainer.epochs(settings.pop("steps"), settings.pop("validations"))
    loggers = [trainer.tensorboard(folder)]
    return trainer.build_trainer(folder, settings, [], loggers, length)
