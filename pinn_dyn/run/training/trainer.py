"""Training of networks by the trainer of Lightning."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import lightning as L
import torch
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.loggers import Logger, TensorBoardLogger
from lightning.pytorch.strategies.launchers import _SubprocessScriptLauncher
from lightning.pytorch.utilities.seed import isolate_rng
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from pinn_dyn.data import LightningData
from pinn_dyn.evaluation import RolloutFigures, RolloutValidator
from pinn_dyn.evaluation.metrics import BEST_BY, error_text, validation_error
from pinn_dyn.mechanics import Predictor
from pinn_dyn.mechanics.compilation import STEPS_FOR_DERIVATIVE
from pinn_dyn.models import Statistics
from pinn_dyn.progress import Progress
from pinn_dyn.run.configuration.build import ConfigError, naming
from pinn_dyn.run.run_folder import CHECKPOINTS, DATA, RECORD, read_checkpoint
from pinn_dyn.run.training.prepared import PreparedTraining, TrainingPlan, prepare
from pinn_dyn.training import DynamicsLearner, LeastSquares, WholeCheckpoints, WindowLoss

LONGEST_EPOCH = 1000
"""Largest number of steps between two writes of the last checkpoint."""
LOSSES = 50
"""Smallest number of losses in the log of a training, if it has as many steps."""
CLIPPING = ("gradient_clip_val", "gradient_clip_algorithm")
"""Arguments of the trainer that the learner takes instead."""


def build_learner(
    model: Predictor,
    statistics: Statistics,
    validator: RolloutValidator,
    *,
    loss: Callable[..., WindowLoss],
    optimizer: Callable[..., Optimizer],
    scheduler: Callable[..., LRScheduler],
    config: dict[str, Any],
    compile: bool,
    clipping: Mapping[str, Any],
) -> DynamicsLearner:
    """Build the LightningModule: model, loss, optimizer and schedule."""
    with naming("loss"):
        window_loss = loss(statistics=statistics, model=model)
    with naming("optimizer"):
        return DynamicsLearner(
            model,
            loss=window_loss,
            optimizer=optimizer,
            scheduler=scheduler,
            validator=validator,
            config=config,
            statistics=statistics,
            compile=compile,
            **clipping,
        )


def epochs(steps: int, validations: int) -> tuple[int, int, int]:
    """Return the epochs of a training, steps in an epoch, and epochs between two validations.

    The steps in an epoch divide those between two validations: the training ends with one.
    """
    between, remainder = divmod(steps, validations)
    if remainder or not between:
        multiple = max(between, 1) * validations
        raise ConfigError(
            f"trainer.steps is {steps}, expected a multiple of validations: set "
            f"trainer.steps={multiple}"
        )
    fewest = -(-between // LONGEST_EPOCH)
    parts = next((n for n in range(fewest, 10 * fewest) if between % n == 0), 1)
    return validations * parts, between // parts, parts


def has_cpp_compiler() -> bool:
    """Return true if torch.compile finds a compiler for the CPU."""
    return any(map(shutil.which, ("g++", "clang++", "c++")))


def compiles(compile: bool | Literal["auto"], steps: int, trainer: Mapping[str, Any]) -> bool:
    """Return whether to compile the dynamics: with ``"auto"`` in long trainings."""
    accelerator = trainer.get("accelerator", "auto")
    on_gpu = torch.cuda.is_available() if accelerator == "auto" else accelerator != "cpu"
    missing = "" if has_cpp_compiler() else "C++ compiler (g++ or clang++) on the path"
    if on_gpu and not missing and not find_spec("triton"):
        missing = "Triton"
    if compile is True and missing:
        raise ConfigError(f"compile is true, but there is no {missing}: set compile=false")
    return steps >= STEPS_FOR_DERIVATIVE and not missing if compile == "auto" else compile


class _MovableCheckpoint(ModelCheckpoint):
    """Checkpoints that keep their best score if the run folder was moved or copied.

    Of equal scores, as where all rollouts diverge, the smaller loss counts.
    """

    _loss = math.inf

    def check_monitor_top_k(self, trainer: L.Trainer, current: Tensor | None = None) -> bool:
        """Tell whether a score is better than the best, or as good with a smaller loss."""
        loss = float(getattr(trainer.lightning_module, "latest_loss", math.nan))
        tied = current is not None and current == self.best_model_score and loss < self._loss
        better = tied or super().check_monitor_top_k(trainer, current)
        self._loss = loss if better else self._loss
        return better

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the score and the paths, in the present folder."""

        def moved(path: str) -> str:
            return str(Path(str(self.dirpath), Path(path).name)) if path else ""

        paths = ("best_model_path", "kth_best_model_path", "last_model_path")
        scores = {moved(path): score for path, score in state_dict["best_k_models"].items()}
        changes = {"dirpath": self.dirpath, "best_k_models": scores}
        changes |= {key: moved(state_dict[key]) for key in paths}
        super().load_state_dict({**state_dict, **changes})


class _ProgressLines(L.Callback):
    progress = Progress(None, 0, "steps")

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Start the lines, in the first process of several."""
        config = pl_module.hparams["config"]
        task = f"training {config['name']} seed {config['seed']}"
        steps = config["trainer"]["steps"]
        self.progress = Progress(task if trainer.is_global_zero else None, steps, "steps")
        self.progress.__enter__()

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *_: Any) -> None:
        """Update the steps, the loss and the validation error."""
        assert isinstance(pl_module, DynamicsLearner)
        text = f", loss {pl_module.latest_loss:.4g}"
        if metrics := validation_metrics(trainer):
            text += f", validation error {error_text(metrics)}"
        self.progress.update(trainer.global_step, text)

    def teardown(self, *_: Any, **__: Any) -> None:
        """End the lines."""
        self.progress.__exit__()

    on_exception = teardown


def build_trainer(
    folder: Path,
    settings: Mapping[str, Any],
    callbacks: Sequence[L.Callback],
    loggers: Sequence[Logger],
    length: tuple[int, int, int],
) -> L.Trainer:
    """Build the trainer with its callbacks and loggers, all writing to ``folder``.

    ``settings`` are arguments of :class:`lightning.Trainer`, ``length`` is that of :func:`epochs`.
    A strategy that starts the program again on each device is refused.
    """
    if "64" in str(precision := settings.get("precision")):
        raise ValueError(f"trainer.precision is {precision!r}, expected '32-true' or 'bf16-mixed'")
    # A resumed training finds its checkpoints by these names.
    files: dict[str, Any] = {"dirpath": str(folder / CHECKPOINTS), "enable_version_counter": False}
    count, batches, interval = length
    arguments = {
        **{key: value for key, value in settings.items() if key not in CLIPPING},
        "enable_progress_bar": False,
        "max_epochs": count,
        "check_val_every_n_epoch": interval,
        "callbacks": [
            *callbacks,
            _MovableCheckpoint(filename="best", monitor=BEST_BY, **files),
            _MovableCheckpoint(filename="last", save_on_train_epoch_end=True, **files),
            *([_ProgressLines()] if settings.get("enable_progress_bar", True) else []),
            *([LearningRateMonitor()] if loggers else []),
        ],
        "logger": list(loggers),
        "plugins": [WholeCheckpoints()],
        "default_root_dir": str(folder),
        "inference_mode": False,  # validation needs derivatives
        "num_sanity_val_steps": 0,
        "log_every_n_steps": max(1, min(100, count * batches // LOSSES)),
        "enable_model_summary": False,
        "use_distributed_sampler": False,  # DynamicsData distributes the windows of a batch
    }
    with naming("trainer"):
        trainer = L.Trainer(**arguments)
    if isinstance(trainer.strategy.launcher, _SubprocessScriptLauncher):
        raise ConfigError(
            "trainer.strategy would start the whole program once per device: use "
            "trainer.strategy=ddp_spawn_find_unused_parameters_true"
        )
    return trainer


def tensorboard(folder: Path) -> TensorBoardLogger:
    """Return the logger of a run folder: one log for all parts of a resumed training."""
    return TensorBoardLogger(str(folder), name="tensorboard", version="", default_hp_metric=False)


def validation_metrics(trainer: L.Trainer) -> dict[str, float]:
    """Return the metrics of the latest validation, empty before the first."""
    metrics = trainer.callback_metrics.items()
    return {name: float(value) for name, value in metrics if name.startswith("val/")}


class Recorder(L.Callback):
    """Record of a training and the identity of its data, for its checkpoints and TensorBoard."""

    def __init__(self, training: PreparedTraining):
        self.training = training

    def on_save_checkpoint(
        self, trainer: L.Trainer, pl_module: L.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add the record and the identity."""
        metrics = validation_metrics(trainer)  # the loss is that of an earlier epoch
        checkpoint[RECORD] = self.training.record(trainer.global_step, metrics)
        checkpoint[DATA] = self.training.identity

    def on_fit_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Log settings and the error of the kept model for the tab HPARAMS of TensorBoard."""
        if not trainer.is_global_zero:
            return
        kept = read_checkpoint(self.training.plan.folder / CHECKPOINTS / "best.ckpt")[RECORD]
        error = validation_error(kept["validation"])
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                settings = self.training.compared_settings()
                logger.log_hyperparams(settings, {"hp/validation_error": error})


@isolate_rng()
def train_network(plan: TrainingPlan, checkpoint: Path | None, saved: Mapping[str, Any]) -> None:
    """Train a model from its start or a checkpoint, and write the run.

    Args:
        plan: the training.
        checkpoint: the checkpoint of an interrupted training, if any.
        saved: its content.
    """
    # A missing compiler or device is refused before data are simulated.
    compiled = compiles(plan.compile, plan.steps, plan.trainer)
    callbacks = [RolloutFigures()] if plan.callbacks is None else plan.callbacks
    loggers = [tensorboard(plan.folder)] if plan.loggers is None else plan.loggers
    length = epochs(plan.steps, plan.validations)
    trainer = build_trainer(plan.folder, plan.trainer, callbacks, loggers, length)
    L.seed_everything(plan.seed, verbose=False)
    training = prepare(plan, saved, batches=length[1])
    model, windows = training.model, training.windows
    if windows.batch_size % trainer.world_size:
        text = f"batch_size {windows.batch_size} is no multiple of {trainer.world_size} devices"
        raise ConfigError(f"data: {text}")
    assert not isinstance(plan.optimizer, LeastSquares)
    learner = build_learner(
        model,
        windows.statistics,
        training.validator,
        loss=plan.loss,
        optimizer=plan.optimizer,
        scheduler=plan.scheduler,
        config=plan.config,
        compile=compiled,
        clipping={key: plan.trainer[key] for key in CLIPPING if key in plan.trainer},
    )
    trainer.callbacks.insert(0, Recorder(training))  # type: ignore[attr-defined]
    data = LightningData(windows)
    try:
        trainer.fit(learner, data, ckpt_path=checkpoint, weights_only=True)
        if checkpoint is not None and not trainer.callback_metrics:  # ended just before its record
            trainer.validate(learner, data, verbose=False)
    except SystemExit as stop:  # Lightning's end of an interrupted training
        raise KeyboardInterrupt from stop
    # Other processes have counted the steps of theirs.
    done = read_checkpoint(plan.folder / CHECKPOINTS / "last.ckpt")["global_step"]
    training.finish(training.record(done, trainer.callback_metrics))
