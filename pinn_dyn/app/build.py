"""Builds the objects that a configuration describes, part by part."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import Logger
from lightning.pytorch.strategies.launchers import _SubprocessScriptLauncher

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.keys import MOST_MEMBERS
from pinn_dyn.app.parts import build_part
from pinn_dyn.app.progress import EpochLines
from pinn_dyn.app.schema import arguments
from pinn_dyn.control import Controller, Reference
from pinn_dyn.data import DataSource, DynamicsData
from pinn_dyn.data.simulation import has_cpp_compiler
from pinn_dyn.ensembles import Ensemble, EnsembleLearner
from pinn_dyn.evaluation import RolloutValidator, RunDescription, ValidationHistory
from pinn_dyn.mechanics import MechanicalSystem, Predictor
from pinn_dyn.mechanics.compilation import STEPS_FOR_DERIVATIVE
from pinn_dyn.models import Statistics
from pinn_dyn.training import (
    DynamicsLearner,
    LeastSquares,
    LeastSquaresLearner,
    WholeCheckpoints,
)

CHECKPOINTS = "checkpoints"
LONGEST_EPOCH = 1000
"""Steps after which the last checkpoint is written anew, at the latest."""
VALIDATION_ERROR = "val/error_mean"
"""What a training is summed up by, and a sweep minimizes."""
_CLIPPING = ("gradient_clip_val", "gradient_clip_algorithm")  # of the trainer, done by the learner
BEST_BY = "val/error_windowed"
"""What the best checkpoint is chosen by: a long roll-out may err least before it learns."""
MONITORED = (
    *("train/loss", BEST_BY, VALIDATION_ERROR, "val/error_median", "val/error_worst"),
    "val/diverged",
)
"""What a callback may watch."""


def build_source(config: dict[str, Any]) -> DataSource:
    """The data source of ``config["dataset"]``; one that simulates has a cache."""
    part = config["dataset"]
    if "cache" in arguments(part.get("_target_"), "dataset"):
        part = {"cache": os.environ.get("PINN_DYN_CACHE", "~/.cache/pinn_dyn"), **part}
    return build_part("dataset", part)


def build_data(config: dict[str, Any], source: DataSource | None = None) -> DynamicsData:
    """The data module of ``config["data"]``, on a source or else that of ``config["dataset"]``."""
    source = build_source(config) if source is None else source
    part = {"seed": config["seed"], **config["data"]}
    _, batches, _ = epochs(config)
    return build_part("data", part, source=source, batches_per_epoch=batches)


def epochs(config: dict[str, Any]) -> tuple[int, int, int]:
    """Epochs of a training, steps in each, and epochs from one validation to the next.

    An epoch is a number of steps that divides the steps between two validations, so that the
    training ends with a validation.

    Raises:
        ConfigError: unless ``trainer.steps`` is a multiple of ``trainer.validations``.
    """
    if not {"steps", "validations"} <= config["trainer"].keys():
        raise ConfigError(
            "trainer has no steps and validations: the configuration was written by pinn_dyn 0.2 "
            "or before, go on with that version, or start again"
        )
    steps, validations = config["trainer"]["steps"], config["trainer"]["validations"]
    between, rest = divmod(steps, validations)
    if rest or not between:
        fitting = max(between, 1) * validations
        raise ConfigError(
            f"trainer.steps is {steps} and trainer.validations {validations}: expected a multiple, "
            f"as trainer.steps={fitting}"
        )
    fewest = -(-between // LONGEST_EPOCH)
    every = next((n for n in range(fewest, 10 * fewest) if between % n == 0), 1)
    return validations * every, between // every, every


def build_model(config: dict[str, Any], statistics: Statistics) -> Predictor:
    """The model of ``config["model"]``, scaled to the data."""
    return build_part("model", config["model"], statistics=statistics)


def ensemble_size(config: dict[str, Any]) -> int:
    """How many models the run trains at once; 1 where a configuration does not know of it.

    Raises:
        ConfigError: unless that is a positive integer.
    """
    size = config.get("ensemble", 1)
    if not isinstance(size, int) or not 1 <= size <= MOST_MEMBERS:
        raise ConfigError(
            f"ensemble is {size}, expected a number of members up to {MOST_MEMBERS}, 1 for a "
            "single model"
        )
    return size


def build_predictor(config: dict[str, Any], statistics: Statistics) -> Predictor:
    """What a run trains: the model, or an ensemble of models of the seeds seed, seed + 1, ..."""
    if ensemble_size(config) == 1:
        return build_model(config, statistics)
    members = []
    for k in range(ensemble_size(config)):
        L.seed_everything(config["seed"] + k, verbose=False)
        members.append(build_model(config, statistics))
    try:
        return Ensemble(members)
    except ValueError as error:
        raise ConfigError(f"ensemble: {error}") from error


def build_learner(
    config: dict[str, Any], model: Predictor, statistics: Statistics, validator: RolloutValidator
) -> DynamicsLearner:
    """The LightningModule: model, loss, optimizer and schedule.

    Raises:
        ConfigError: if compilation is asked for and there is no C++ compiler.
    """
    ensemble = isinstance(model, Ensemble)
    single = model.member(0) if isinstance(model, Ensemble) else model
    loss = build_part("loss", config["loss"], statistics=statistics, model=single)
    steps = "params" in arguments(config["optimizer"]["_target_"], "optimizer")
    optimizer = build_part("optimizer", config["optimizer"], partial_=steps)
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
    scheduler = build_part("scheduler", config["scheduler"], partial_=True)
    try_step(optimizer, scheduler, config["trainer"]["steps"])
    return (EnsembleLearner if ensemble else DynamicsLearner)(
        model,
        loss=loss,
        optimizer=optimizer,
        scheduler=scheduler,
        validator=validator,
        config=config,
        statistics=statistics,
        compile=compiles(config),
        **{key: config["trainer"][key] for key in _CLIPPING if key in config["trainer"]},
    )


def try_step(optimizer: Any, scheduler: Any, steps: int) -> None:
    """Refuse settings that the first step of a training would, by a step on a small matrix."""
    weights = torch.nn.Parameter(torch.eye(2))

    def closure() -> torch.Tensor:
        weights.grad = torch.ones_like(weights)
        return weights.sum()

    part = "optimizer"
    try:
        stepped = optimizer([weights])
        part = "scheduler"
        schedule = scheduler(stepped, total_steps=steps)
        part = "optimizer"
        stepped.step(closure)
        part = "scheduler"
        schedule.step()
    except Exception as error:  # nobody's own classes raise one kind alone
        raise ConfigError(
            f"{part}: its settings are refused at the first step: {type(error).__name__}: {error}"
        ) from error


def compiles(config: dict[str, Any]) -> bool:
    """Whether to compile the dynamics: as told, or with ``auto`` where it pays.

    Raises:
        ConfigError: as :func:`require_compiler`.
    """
    require_compiler(config)
    if config["compile"] != "auto":
        return config["compile"]
    long = config["trainer"]["steps"] >= STEPS_FOR_DERIVATIVE
    return long and _lacking_compiler(config) is None


def require_device(config: dict[str, Any]) -> None:
    """Refuse to train on a GPU where there is none.

    Raises:
        ConfigError: if ``trainer.accelerator`` is a GPU that torch does not see.
    """
    accelerator = config["trainer"]["accelerator"]
    if accelerator in ("gpu", "cuda") and not torch.cuda.is_available():
        why = (
            "no GPU answers (nvidia-smi lists them)"
            if torch.version.cuda or torch.version.hip
            else f"torch {torch.__version__} is a build without CUDA (pytorch.org has others)"
        )
        raise ConfigError(
            f"trainer.accelerator is {accelerator}, but {why}: mend that, or take "
            "trainer.accelerator=cpu"
        )


def require_compiler(config: dict[str, Any]) -> None:
    """Refuse to compile without a compiler.

    Raises:
        ConfigError: if ``compile`` is true and there is no C++ compiler, or no Triton for a GPU.
    """
    if config["compile"] is True and (lacking := _lacking_compiler(config)):
        raise ConfigError(
            f"compile is true, but there is {lacking}: install one, or set compile=false"
        )


def _lacking_compiler(config: dict[str, Any]) -> str | None:
    """What compiling lacks on the device of a training."""
    if not has_cpp_compiler():
        return "no C++ compiler (g++ or clang++) on the path"
    accelerator = config["trainer"]["accelerator"]
    on_gpu = torch.cuda.is_available() if accelerator == "auto" else accelerator != "cpu"
    if on_gpu and find_spec("triton") is None:
        return "no Triton (pip install triton), which compiles for a GPU"
    return None


def build_validator(config: dict[str, Any], training_step: float) -> RolloutValidator:
    """The validator of ``config["validator"]``."""
    return build_part("validator", config["validator"], training_step=training_step)


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
        "figures": {
            "validator": validator,
            "labels": source.labels,
            "input_labels": source.input_labels,
            "system": source.system,
            "configurations": source.configurations,
        },
    }
    named = {
        name: build_part(f"callbacks.{name}", part, **needs.get(name, {}))
        for name, part in config["callbacks"].items()
        if part is not None
    }
    callbacks = list(named.values())
    # A resumed training finds them by these names.
    saved: dict[str, Any] = {
        "dirpath": str(folder / CHECKPOINTS),
        "enable_version_counter": False,
    }
    callbacks += [
        ModelCheckpoint(filename="best", monitor=BEST_BY, **saved),
        ModelCheckpoint(filename="last", save_on_train_epoch_end=True, **saved),
        ValidationHistory(),
    ]
    ours = ("steps", "validations", *_CLIPPING)
    part = {key: x for key, x in config["trainer"].items() if key not in ours}
    part["enable_progress_bar"] = part.get("enable_progress_bar", True) and sys.stdout.isatty()
    bar = part["enable_progress_bar"]
    callbacks.append(TQDMProgressBar() if bar else EpochLines(VALIDATION_ERROR))
    loggers = [_logger(name, x, folder) for name, x in config["logger"].items()]
    if loggers:
        callbacks.append(LearningRateMonitor())
    for name, callback in named.items():
        if (wanted := getattr(callback, "monitor", None)) not in (None, *MONITORED):
            raise ConfigError(
                f"callbacks.{name}.monitor is {wanted!r}, expected one of {', '.join(MONITORED)}"
            )
    count, batches, every = epochs(config)
    return build_part(
        "trainer",
        part,
        max_epochs=count,
        check_val_every_n_epoch=every,
        callbacks=[*callbacks, description],
        logger=loggers,
        plugins=[WholeCheckpoints()],
        default_root_dir=str(folder),
        inference_mode=False,  # validation needs derivatives
        num_sanity_val_steps=0,
        log_every_n_steps=min(100, batches),
        enable_model_summary=False,
        use_distributed_sampler=False,  # DynamicsData deals the windows of a batch out itself
    )


def _logger(name: str, config: dict[str, Any], folder: Path) -> Logger:
    """A logger that knows the run folder."""
    extra: dict[str, Any] = {}
    if name == "tensorboard":  # one log for all parts of a training, also a resumed one
        extra = {"name": "tensorboard", "version": "", "default_hp_metric": False}
    if name == "mlflow":
        extra = {"tags": {"folder": str(folder.resolve())}}
    try:
        return build_part(f"logger.{name}", config, save_dir=str(folder), **extra)
    except ConfigError as error:
        if not isinstance(error.__cause__, ModuleNotFoundError):
            raise
        raise ConfigError(
            f"logger.{name}: a package is missing, install it with pip install "
            f"'pinn_dyn[{name}]', or leave out logger={name} ({error.__cause__})"
        ) from error


def check_processes(trainer: L.Trainer, batch_size: int) -> None:
    """Refuse what would go wrong on several devices.

    Raises:
        ConfigError: if the strategy starts the program again, or batches cannot be dealt out.
    """
    if isinstance(trainer.strategy.launcher, _SubprocessScriptLauncher):
        raise ConfigError(
            "trainer: on several devices this strategy starts the whole program again, a sweep "
            "included: take trainer.strategy=ddp_spawn_find_unused_parameters_true"
        )
    if batch_size % trainer.world_size:
        raise ConfigError(
            f"data.batch_size is {batch_size}, expected a multiple of the {trainer.world_size} "
            "devices that share a batch"
        )


def build_reference(config: dict[str, Any], robot: MechanicalSystem) -> Reference:
    """The reference of ``config["reference"]``; one that needs the robot's kinematics gets it."""
    part = config["reference"]
    return build_part("reference", part, *([robot] if part.get("_partial_") else []))


def build_law(
    config: dict[str, Any], name: str, learned: Predictor, truth: MechanicalSystem
) -> Controller:
    """One of ``config["controllers"]``, on the terms that it asks for, with its observer if any.

    Raises:
        ConfigError: if the law cannot be built on these terms.
    """
    part = config["controllers"][name]
    models = {"learned": learned, "truth": truth}
    gains = {f"{key}_gain": value for key, value in config["gains"].items()}
    law = build_part(f"controllers.{name}.law", {**gains, **part["law"]}, models[part["terms"]])
    if part.get("observer") is None:
        return law
    return build_part(f"controllers.{name}.observer", part["observer"], law)
