"""Builds objects from configurations; every call of Hydra's ``instantiate`` is in this file."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import lightning as L
from hydra.errors import InstantiationException
from hydra.utils import get_object, instantiate
from lightning.pytorch.callbacks import TQDMProgressBar
from lightning.pytorch.loggers import Logger
from lightning.pytorch.strategies.launchers import _SubprocessScriptLauncher

from pinn_dyn.app.config import ConfigError
from pinn_dyn.control import Actuator, Controller, Plant, Reference, Sensor
from pinn_dyn.data import DataSource, DynamicsData, InitialStates
from pinn_dyn.data.simulation import has_cpp_compiler
from pinn_dyn.evaluation import RolloutValidator, RunDescription
from pinn_dyn.mechanics import Ensemble, MechanicalSystem, Predictor
from pinn_dyn.models import Statistics
from pinn_dyn.training import (
    DynamicsLearner,
    EnsembleLearner,
    IncrementLoss,
    LeastSquares,
    LeastSquaresLearner,
)

CHECKPOINTS = "checkpoints"
STEPS_TO_COMPILE = 5000
"""Planned training steps from which ``compile: auto`` compiles; see benchmarks/README.md."""


def _build(name: str, config: dict[str, Any], *given: Any, **extra: Any) -> Any:
    """Instantiate a part of the configuration; its own error message comes first.

    Raises:
        ConfigError: naming the part, with what its constructor said.
    """
    try:
        # Plain lists and dicts reach the constructors: no room below knows a config object.
        built = instantiate(config, _convert_="all")
        return built(*given, **extra) if given or extra else built
    except (InstantiationException, TypeError, ValueError) as error:
        # Hydra wraps what a constructor said.
        wrapped = isinstance(error, InstantiationException) and error.__cause__
        said = str(wrapped or error)
        if "unexpected keyword argument" in said:
            said = _unknown_option(name, config) or said
        raise ConfigError(f"{name}: {said}") from error


def _unknown_option(path: str, config: Any) -> str | None:
    """What to say of the first option that its class does not take; None if there is none.

    An experiment sets options of the classes that it chooses. They stay behind where the command
    line chooses another class.
    """
    if not isinstance(config, dict):
        return None
    if "_target_" in config:
        target = get_object(config["_target_"])
        takes = inspect.signature(target).parameters
        if not any(one.kind is one.VAR_KEYWORD for one in takes.values()):
            for key in config:
                if key not in takes and not key.startswith("_"):
                    return (
                        f"{target.__name__} takes no {key!r}; if an experiment has it for another "
                        f"class, remove it by '~{path}.{key}'"
                    )
    found = (_unknown_option(f"{path}.{key}", part) for key, part in config.items())
    return next((said for said in found if said), None)


def build_source(config: dict[str, Any]) -> DataSource:
    """The data source of ``config["dataset"]``."""
    return _build("dataset", config["dataset"])


def build_data(config: dict[str, Any]) -> DynamicsData:
    """The data module of ``config["data"]`` on the data source."""
    source = build_source(config)
    part = {**config["data"], "_partial_": True}
    return _build("data", part, source=source, members=ensemble_size(config))


def build_model(config: dict[str, Any], statistics: Statistics) -> Predictor:
    """The model of ``config["model"]``, scaled to the data."""
    return _build("model", config["model"], statistics=statistics)


def ensemble_size(config: dict[str, Any]) -> int:
    """How many models the run trains at once; 1 where a configuration does not know of it.

    Raises:
        ConfigError: unless that is a positive integer.
    """
    size = config.get("ensemble", 1)
    if not isinstance(size, int) or size < 1:
        raise ConfigError(f"ensemble is {size}, expected a number of members, 1 for a single model")
    return size


def build_predictor(config: dict[str, Any], statistics: Statistics) -> Predictor:
    """What a run trains: the model, or an ensemble of models of the seeds seed, seed + 1, ..."""
    if ensemble_size(config) == 1:
        return build_model(config, statistics)
    members = []
    for k in range(ensemble_size(config)):
        L.seed_everything(config["seed"] + k, verbose=False)
        members.append(build_model(config, statistics))
    return Ensemble(members)


def build_learner(
    config: dict[str, Any], model: Predictor, statistics: Statistics, validator: RolloutValidator
) -> DynamicsLearner:
    """The LightningModule: model, loss, optimizer and schedule.

    Raises:
        ConfigError: if compilation is asked for and there is no C++ compiler, or an ensemble with a
            loss that knows none.
    """
    ensemble = isinstance(model, Ensemble)
    single = model.member(0) if isinstance(model, Ensemble) else model
    loss = _build("loss", config["loss"], statistics=statistics, model=single)
    if ensemble and not isinstance(loss, IncrementLoss):
        raise ConfigError(
            f"ensemble is {config['ensemble']}, and {type(loss).__name__} trains one model at a "
            "time: take loss=increment, or train the seeds one by one (-m seed=0,1,2)"
        )
    optimizer = _build("optimizer", config["optimizer"])
    if isinstance(optimizer, LeastSquares):
        try:
            return LeastSquaresLearner(
                model,  # type: ignore[arg-type]
                solver=optimizer,
                loss=loss,
                validator=validator,
                config=config,
                statistics=statistics,
            )
        except TypeError as error:
            raise ConfigError(f"optimizer: {error}") from error
    return (EnsembleLearner if ensemble else DynamicsLearner)(
        model,
        loss=loss,
        optimizer=optimizer,
        scheduler=_build("scheduler", config["scheduler"]),
        validator=validator,
        config=config,
        statistics=statistics,
        compile=compiles(config),
    )


def compiles(config: dict[str, Any]) -> bool:
    """Whether to compile the dynamics: as told, or with ``auto`` where it pays.

    Raises:
        ConfigError: on another choice, or true without a C++ compiler.
    """
    choice = config["compile"]
    if choice == "auto":
        steps = config["trainer"]["max_epochs"] * config["data"]["batches_per_epoch"]
        on_cpu = config["trainer"]["accelerator"] == "cpu"
        return on_cpu and steps >= STEPS_TO_COMPILE and has_cpp_compiler()
    if not isinstance(choice, bool):
        raise ConfigError(f"compile is {choice!r}, expected true, false or auto")
    if choice and not has_cpp_compiler():
        raise ConfigError(
            "compile is true, but there is no C++ compiler (g++ or clang++) on the path: install "
            "one, or set compile=false"
        )
    return choice


def build_validator(config: dict[str, Any], training_step: float) -> RolloutValidator:
    """The validator of ``config["validator"]``."""
    return _build("validator", config["validator"], training_step=training_step)


def build_trainer(
    config: dict[str, Any],
    folder: Path,
    source: DataSource,
    validator: RolloutValidator,
    description: RunDescription,
) -> L.Trainer:
    """The trainer with its callbacks and loggers, all writing to ``folder``.

    Raises:
        ConfigError: on a logger whose package is not installed.
    """
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
    if config["trainer"].get("enable_progress_bar"):
        # Drawing at every step takes a tenth of the time of a small network's step.
        callbacks.append(TQDMProgressBar(refresh_rate=20))
    loggers = [_build_logger(name, part, folder) for name, part in config["logger"].items()]
    return _build(
        "trainer",
        {**config["trainer"], "_partial_": True},
        callbacks=[*callbacks, description],
        logger=loggers,
        default_root_dir=str(folder),
        use_distributed_sampler=False,  # DynamicsData deals the windows of a batch out itself
    )


def _build_logger(name: str, config: dict[str, Any], folder: Path) -> Logger:
    """A logger that knows the run folder."""
    extra = {"tags": {"folder": str(folder.resolve())}} if name == "mlflow" else {}
    try:
        return _build(f"logger.{name}", config, save_dir=str(folder), **extra)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"logger.{name}: a package is missing, install it with pip install "
            f"'pinn_dyn[{name}]', or leave out logger={name} ({error})"
        ) from error


def check_processes(trainer: L.Trainer, batch_size: int) -> None:
    """Refuse what would go wrong on several devices.

    Raises:
        ConfigError: if the strategy starts the program again, or batches cannot be dealt out.
    """
    if isinstance(trainer.strategy.launcher, _SubprocessScriptLauncher):
        raise ConfigError(
            "trainer: on several devices this strategy starts the whole program again, a sweep "
            "included: take trainer.strategy=ddp_spawn_find_unused_parameters_true, as trainer=ddp"
        )
    if batch_size % trainer.world_size:
        raise ConfigError(
            f"data.batch_size is {batch_size}, expected a multiple of the {trainer.world_size} "
            "devices that share a batch"
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
    """One of ``config["controllers"]``, on the terms that it asks for, with its observer if any.

    Raises:
        ConfigError: on terms of another name, or a law that cannot be built on them.
    """
    part = config["controllers"][name]
    models = {"learned": learned, "truth": truth}
    if part["terms"] not in models:
        raise ConfigError(
            f"controllers.{name}.terms is {part['terms']!r}, expected {' or '.join(models)}"
        )
    law = _build(f"controllers.{name}.law", part["law"], models[part["terms"]])
    if "observer" not in part:
        return law
    return _build(f"controllers.{name}.observer", part["observer"], law)


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
