"""Parts of a training that write, log and compile: trainer, learner, record."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import lightning as L
import torch
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import Logger, TensorBoardLogger
from lightning.pytorch.strategies.launchers import _SubprocessScriptLauncher
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.progress import EpochLines
from pinn_dyn.app.run import BEST_BY, VALIDATION_ERROR
from pinn_dyn.app.run_folder import CHECKPOINTS, DATA, RECORD
from pinn_dyn.data.simulation import has_cpp_compiler
from pinn_dyn.ensembles import Ensemble, EnsembleLearner
from pinn_dyn.evaluation import RolloutValidator, RunDescription
from pinn_dyn.mechanics import Predictor
from pinn_dyn.mechanics.compilation import STEPS_FOR_DERIVATIVE
from pinn_dyn.models import Statistics
from pinn_dyn.training import (
    DynamicsLearner,
    LeastSquares,
    LeastSquaresLearner,
    WholeCheckpoints,
    WindowLoss,
)

LONGEST_EPOCH = 1000
"""Largest number of steps between two writes of the last checkpoint."""
CLIPPING = ("gradient_clip_val", "gradient_clip_algorithm")
"""Arguments of the trainer that the learner takes instead."""


@contextlib.contextmanager
def naming(part: str) -> Iterator[None]:
    """Name the part of the configuration that a constructor or a check complains about."""
    try:
        yield
    except ConfigError:
        raise
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{part}: {error}") from error


def build_learner(
    model: Predictor,
    statistics: Statistics,
    validator: RolloutValidator,
    *,
    loss: Callable[..., WindowLoss],
    optimizer: Callable[..., Optimizer] | LeastSquares,
    scheduler: Callable[..., LRScheduler],
    config: dict[str, Any],
    compile: bool,
    clipping: Mapping[str, Any],
) -> DynamicsLearner:
    """Build the LightningModule: model, loss, optimizer and schedule."""
    with naming("loss"):
        single = model.member(0) if isinstance(model, Ensemble) else model
        window_loss = loss(statistics=statistics, model=single)
    common: dict[str, Any] = {
        "loss": window_loss,
        "validator": validator,
        "config": config,
        "statistics": statistics,
    }
    with naming("optimizer"):
        if isinstance(optimizer, LeastSquares):
            return LeastSquaresLearner(model, solver=optimizer, **common)  # type: ignore[arg-type]
        learner = EnsembleLearner if isinstance(model, Ensemble) else DynamicsLearner
        common |= {"optimizer": optimizer, "scheduler": scheduler, "compile": compile}
        return learner(model, **common, **clipping)


def even_validations(steps: int, limit: int) -> int:
    """Return the largest number of validations, up to ``limit``, that divides the steps."""
    return max(count for count in range(1, limit + 1) if steps % count == 0)


def epochs(steps: int, validations: int) -> tuple[int, int, int]:
    """Return the epochs of a training, steps in an epoch, and epochs between two validations.

    An epoch is a number of steps that divides the steps between two validations, so that the
    training ends with a validation.

    Raises:
        ConfigError: unless ``steps`` is a multiple of ``validations``.
    """
    between, remainder = divmod(steps, validations)
    if remainder or not between:
        raise ConfigError(
            f"trainer.steps is {steps} and trainer.validations {validations}: expected a multiple, "
            f"as trainer.steps={max(between, 1) * validations}"
        )
    fewest = -(-between // LONGEST_EPOCH)
    parts = next((n for n in range(fewest, 10 * fewest) if between % n == 0), 1)
    return validations * parts, between // parts, parts


def require_device(trainer: Mapping[str, Any]) -> None:
    """Refuse to train on a GPU that torch does not see, before the data are simulated."""
    accelerator = trainer.get("accelerator", "auto")
    if accelerator in ("gpu", "cuda") and not torch.cuda.is_available():
        reason = (
            "no GPU answers (nvidia-smi lists them)"
            if torch.version.cuda or torch.version.hip
            else f"torch {torch.__version__} is a build without CUDA (pytorch.org has others)"
        )
        raise ConfigError(
            f"trainer.accelerator is {accelerator}, but {reason}: use trainer.accelerator=cpu"
        )


def compiles(compile: bool | Literal["auto"], steps: int, trainer: Mapping[str, Any]) -> bool:
    """Decide whether to compile the dynamics: with ``"auto"`` in long trainings.

    Raises:
        ConfigError: if compilation is demanded and there is no compiler.
    """
    missing = _missing_compiler(trainer)
    if compile is True and missing:
        raise ConfigError(f"compile is true, but {missing}: install it, or set compile=false")
    return steps >= STEPS_FOR_DERIVATIVE and not missing if compile == "auto" else compile


def _missing_compiler(trainer: Mapping[str, Any]) -> str:
    if not has_cpp_compiler():
        return "there is no C++ compiler (g++ or clang++) on the path"
    accelerator = trainer.get("accelerator", "auto")
    on_gpu = torch.cuda.is_available() if accelerator == "auto" else accelerator != "cpu"
    return "there is no Triton (pip install triton)" if on_gpu and not find_spec("triton") else ""


def build_trainer(
    folder: Path,
    settings: Mapping[str, Any],
    callbacks: Sequence[L.Callback],
    loggers: Sequence[Logger],
    recorders: Sequence[L.Callback],
    length: tuple[int, int, int],
    batch_size: int,
) -> L.Trainer:
    """Build the trainer with its callbacks and loggers, all writing to ``folder``.

    Args:
        folder: the run folder.
        settings: arguments of :class:`lightning.Trainer`.
        callbacks: callbacks of the user, before those of the program.
        loggers: loggers.
        recorders: callbacks after those of the program.
        length: as returned by :func:`epochs`.
        batch_size: windows in a batch, which the devices share.

    Raises:
        ConfigError: if the strategy starts the program again on each device, or the devices cannot
            share a batch equally.
    """
    # A resumed training finds its checkpoints by these names.
    files: dict[str, Any] = {"dirpath": str(folder / CHECKPOINTS), "enable_version_counter": False}
    bar = settings.get("enable_progress_bar", True) and sys.stdout.isatty()
    added = [
        ModelCheckpoint(filename="best", monitor=BEST_BY, **files),
        ModelCheckpoint(filename="last", save_on_train_epoch_end=True, **files),
        TQDMProgressBar() if bar else EpochLines(VALIDATION_ERROR),
        *([LearningRateMonitor()] if loggers else []),
    ]
    count, batches, interval = length
    arguments = {
        **{key: value for key, value in settings.items() if key not in CLIPPING},
        "enable_progress_bar": bar,
        "max_epochs": count,
        "check_val_every_n_epoch": interval,
        "callbacks": [*callbacks, *added, *recorders],
        "logger": list(loggers),
        "plugins": [WholeCheckpoints()],
        "default_root_dir": str(folder),
        "inference_mode": False,  # validation needs derivatives
        "num_sanity_val_steps": 0,
        "log_every_n_steps": min(100, batches),
        "enable_model_summary": False,
        "use_distributed_sampler": False,  # DynamicsData distributes the windows of a batch
    }
    with naming("trainer"):
        trainer = L.Trainer(**arguments)
    if isinstance(trainer.strategy.launcher, _SubprocessScriptLauncher):
        raise ConfigError(
            "trainer: on several devices this strategy starts the whole program again, a sweep "
            "included: use trainer.strategy=ddp_spawn_find_unused_parameters_true"
        )
    if batch_size % trainer.world_size:
        raise ConfigError(
            f"data.batch_size is {batch_size}, expected a multiple of the {trainer.world_size} "
            "devices that share a batch"
        )
    return trainer


def tensorboard(folder: Path) -> TensorBoardLogger:
    """Return the logger of a run folder: one log for all parts of a resumed training."""
    return TensorBoardLogger(str(folder), name="tensorboard", version="", default_hp_metric=False)


def few_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that loggers compare if nobody chose others."""
    settings = {"model": config["model_name"], "dataset": config["dataset"]["name"]}
    numbers = {"data": ("pairs", "steps", "stride", "batch_size"), "optimizer": ("lr",)}
    numbers["trainer"] = ("steps",)
    for part, keys in numbers.items():
        values = config[part] or {}
        settings |= {f"{part}.{key}": values[key] for key in keys if key in values}
    return {**settings, "seed": config["seed"]}


class Recorder(L.Callback):
    """Puts the metrics of the run and the identity of its data into every checkpoint."""

    def __init__(
        self,
        config: Mapping[str, Any],
        pairs: int,
        identity: Mapping[str, Any],
        description: RunDescription,
    ):
        self.facts = {"name": config["name"], "seed": config["seed"], "pairs": pairs}
        self.identity = identity
        self.description = description

    def record(self, trainer: L.Trainer, model: torch.nn.Module, steps: int) -> dict[str, Any]:
        """Return the record of the run so far."""
        return {
            **self.facts,
            "parameters": sum(p.numel() for p in model.parameters()),
            "training_seconds": self.description.seconds,
            "steps": steps,
            "validation": {key: float(x) for key, x in trainer.callback_metrics.items()},
            **self.description.provenance,
        }

    def on_save_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add the record and the identity."""
        checkpoint[RECORD] = self.record(trainer, pl_module, trainer.global_step)
        checkpoint[DATA] = self.identity
