"""Builds objects from configurations; every call of Hydra's ``instantiate`` is in this file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning as L
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning.pytorch.loggers import TensorBoardLogger

from pinn_dyn.app.config import ConfigError
from pinn_dyn.data import DataSource, DynamicsData
from pinn_dyn.data.simulation import has_cpp_compiler
from pinn_dyn.evaluation import RolloutValidator
from pinn_dyn.mechanics import Predictor
from pinn_dyn.models import Statistics
from pinn_dyn.training import DynamicsLearner

CHECKPOINTS = "checkpoints"


def _build(name: str, config: dict[str, Any], **extra: Any) -> Any:
    """Instantiate a part of the configuration; its own error message comes first.

    Raises:
        ConfigError: naming the part, with what its constructor said.
    """
    try:
        # Plain lists and dicts reach the constructors: no room below knows a config object.
        built = instantiate(config, _convert_="all")
        return built(**extra) if extra else built
    except InstantiationException as error:
        raise ConfigError(f"{name}: {error.__cause__ or error}") from error
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{name}: {error}") from error


def build_source(config: dict[str, Any]) -> DataSource:
    """The data source of ``config["dataset"]``."""
    return _build("dataset", config["dataset"])


def build_data(config: dict[str, Any]) -> DynamicsData:
    """The data module of ``config["data"]`` on the data source."""
    source = build_source(config)
    return _build("data", {**config["data"], "_partial_": True}, source=source)


def build_model(config: dict[str, Any], statistics: Statistics) -> Predictor:
    """The model of ``config["model"]``, scaled to the data."""
    return _build("model", config["model"], statistics=statistics)


def build_learner(
    config: dict[str, Any], model: Predictor, statistics: Statistics, validator: RolloutValidator
) -> DynamicsLearner:
    """The LightningModule: model, loss, optimizer and schedule.

    Raises:
        ConfigError: if compilation is asked for and there is no C++ compiler.
    """
    if config["compile"] and not has_cpp_compiler():
        raise ConfigError(
            "compile is true, but there is no C++ compiler (g++ or clang++) on the path: install "
            "one, or set compile=false"
        )
    return DynamicsLearner(
        model,
        loss=_build("loss", config["loss"], statistics=statistics, model=model),
        optimizer=_build("optimizer", config["optimizer"]),
        scheduler=_build("scheduler", config["scheduler"]),
        validator=validator,
        config=config,
        statistics=statistics,
        compile=config["compile"],
    )


def build_validator(config: dict[str, Any], training_step: float) -> RolloutValidator:
    """The validator of ``config["validator"]``."""
    return _build("validator", config["validator"], training_step=training_step)


def build_trainer(
    config: dict[str, Any], folder: Path, source: DataSource, validator: RolloutValidator
) -> L.Trainer:
    """The trainer with its callbacks and the TensorBoard logger, all writing to ``folder``."""
    # What a callback needs beyond its configuration, by its name there.
    needs: dict[str, dict[str, Any]] = {
        "best": {"dirpath": str(folder / CHECKPOINTS)},
        "last": {"dirpath": str(folder / CHECKPOINTS)},
        "figures": {
            "validator": validator,
            "labels": source.labels,
            "input_labels": source.input_labels,
            "system": source.system,
            "configurations": source.configurations,
        },
    }
    callbacks = [
        _build(f"callbacks.{name}", part, **needs.get(name, {}))
        for name, part in config["callbacks"].items()
    ]
    logger = TensorBoardLogger(str(folder), name="tensorboard", version="", default_hp_metric=False)
    return _build(
        "trainer",
        {**config["trainer"], "_partial_": True},
        callbacks=callbacks,
        logger=logger,
        default_root_dir=str(folder),
    )
