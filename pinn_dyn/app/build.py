"""Builds objects from configurations; every call of Hydra's ``instantiate`` is in this file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning as L
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning.pytorch.loggers import TensorBoardLogger

from pinn_dyn.app.config import ConfigError
from pinn_dyn.control import Actuator, Controller, Plant, Reference, Sensor
from pinn_dyn.data import DataSource, DynamicsData, InitialStates
from pinn_dyn.data.simulation import has_cpp_compiler
from pinn_dyn.evaluation import RolloutValidator
from pinn_dyn.mechanics import MechanicalSystem, Predictor
from pinn_dyn.models import Statistics
from pinn_dyn.training import DynamicsLearner

CHECKPOINTS = "checkpoints"


def _build(name: str, config: dict[str, Any], *given: Any, **extra: Any) -> Any:
    """Instantiate a part of the configuration; its own error message comes first.

    Raises:
        ConfigError: naming the part, with what its constructor said.
    """
    try:
        # Plain lists and dicts reach the constructors: no room below knows a config object.
        built = instantiate(config, _convert_="all")
        return built(*given, **extra) if given or extra else built
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


def build_robot(dataset: dict[str, Any], changes: dict[str, Any]) -> MechanicalSystem:
    """The system of a data set, with some arguments of its constructor changed."""
    return _build("robot", {**dataset["system"], **changes})


def build_reference(config: dict[str, Any], robot: MechanicalSystem) -> Reference:
    """The reference of ``config["reference"]``; one that needs the robot's kinematics gets it."""
    part = config["reference"]
    return _build("reference", part, *([robot] if part.get("_partial_") else []))


def build_law(
    config: dict[str, Any], name: str, learned: Predictor, truth: MechanicalSystem
) -> Controller:
    """One of ``config["controllers"]``, on the terms that it asks for.

    Raises:
        ConfigError: on terms of another name, or a law that cannot be built on them.
    """
    part = config["controllers"][name]
    models = {"learned": learned, "truth": truth}
    if part["terms"] not in models:
        raise ConfigError(
            f"controllers.{name}.terms is {part['terms']!r}, expected {' or '.join(models)}"
        )
    return _build(f"controllers.{name}", part["law"], models[part["terms"]])


def build_plant(config: dict[str, Any], robot: MechanicalSystem) -> Plant:
    """The plant of ``config["plant"]``, made of the robot."""
    return _build("plant", config["plant"], robot)


def build_actuator(config: dict[str, Any]) -> Actuator:
    """The limits of ``config["actuator"]``."""
    return _build("actuator", config["actuator"])


def build_sensor(config: dict[str, Any]) -> Sensor:
    """The noise of ``config["sensor"]``."""
    return _build("sensor", config["sensor"])


def build_initial_states(config: dict[str, Any]) -> InitialStates:
    """The box of ``config["initial_states"]``."""
    return _build("initial_states", config["initial_states"])
