"""Model and data of a training, built and checked."""

from __future__ import annotations

import copy
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from pinn_dyn.atomic_files import write_whole
from pinn_dyn.data import DataSource, DynamicsData, LogSource, data_identity, store
from pinn_dyn.data.bandwidth import too_long_for
from pinn_dyn.evaluation import RolloutValidator
from pinn_dyn.evaluation.baselines import ConstantVelocity
from pinn_dyn.evaluation.metrics import BEST_BY, score
from pinn_dyn.mechanics import Predictor, stack_until
from pinn_dyn.models import KnownAndNetwork, KnownMechanics
from pinn_dyn.models.cholesky import set_output_limits
from pinn_dyn.run.configuration.build import ConfigError, ModelBuilder, naming
from pinn_dyn.run.provenance import provenance
from pinn_dyn.run.run import TRAJECTORIES, Run
from pinn_dyn.run.run_folder import (
    DATA,
    RECORD,
    REPLACE,
    finish,
    flattened,
    in_one_line,
    require_same_data,
)
from pinn_dyn.run.training.known_data import check_known, warn_of_log
from pinn_dyn.training import LeastSquares, WindowLoss

if TYPE_CHECKING:
    from lightning import Callback
    from lightning.pytorch.loggers import Logger

_COMPARED = ("model_name", "seed", "dataset.name", "data.", "model.", "optimizer.", "trainer.steps")
"""Beginnings of the settings that TensorBoard shows beside the validation error."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainingPlan:
    """A training with all its parts, its run folder and what it reports.

    Attributes:
        source, model, loss, optimizer, scheduler, data, validator: as in :func:`~pinn_dyn.train`.
        steps, validations: steps of the optimizer, and number of validations.
        seed, compile, threads, trainer, callbacks, loggers: as in :func:`~pinn_dyn.train`.
        start_from: a run whose weights or constants the training starts from.
        folder: the run folder.
        stores_data: true to store the trajectories in the folder.
        config: description of the run, which its checkpoint keeps.
    """

    source: DataSource
    model: ModelBuilder | Predictor
    loss: Callable[..., WindowLoss]
    optimizer: Callable[..., Optimizer] | LeastSquares
    scheduler: Callable[..., LRScheduler]
    data: Callable[..., DynamicsData]
    validator: Callable[..., RolloutValidator]
    steps: int
    validations: int
    seed: int
    compile: bool | Literal["auto"]
    threads: int
    trainer: Mapping[str, Any]
    callbacks: Sequence[Callback] | None
    loggers: Sequence[Logger] | None
    start_from: Run | None
    folder: Path
    stores_data: bool
    config: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class PreparedTraining:
    """Model and data of a training in a run folder.

    Attributes:
        plan: the training.
        model: the model, with the weights to start from.
        windows: training windows and validation trajectories.
        validator: errors of rollouts.
        identity: identity of the data.
        facts: name, seed, windows, software and hardware, for the record.
        start, processor_start: times at which the training started, without interruptions, of the
            clock and of the processor, s.
    """

    plan: TrainingPlan
    model: Predictor
    windows: DynamicsData
    validator: RolloutValidator
    identity: dict[str, Any]
    facts: dict[str, Any]
    start: float
    processor_start: float

    def record(self, steps: int, validation: Mapping[str, Any], **facts: Any) -> dict[str, Any]:
        """Return the record of a training of some steps, with the metrics of its model."""
        return {
            **self.facts,
            **facts,
            "parameters": sum(p.numel() for p in self.model.parameters()),
            "training_seconds": time.perf_counter() - self.start,
            "processor_seconds": time.process_time() - self.processor_start,
            "steps": steps,
            "validation": {key: float(value) for key, value in validation.items()},
        }

    def compared_settings(self) -> dict[str, Any]:
        """Return the settings that TensorBoard shows beside the validation error."""
        flat = flattened(self.plan.config)
        settings = {key: value for key, value in flat.items() if key.startswith(_COMPARED)}
        return {key: x if isinstance(x, (int, float)) else str(x) for key, x in settings.items()}

    def finish(self, record: dict[str, Any], reasons: Callable[[], Sequence[str]] = tuple) -> None:
        """Write the record of the last step, completed by the score of the model that is kept.

        A warning names a model that predicts no better than constant velocity, with the reasons.
        """
        record = finish(self.plan.folder, record)
        log.info(
            "%s seed %d: validation error over %s %s, after %.0f s of training, in %s",
            *(record["name"], record["seed"], self.validator, score(record)),
            *(record["training_seconds"], self.plan.folder),
        )
        still = ConstantVelocity(self.model.num_coordinates, self.model.num_inputs)
        truth = stack_until(self.windows.splits.validation)
        rival = self.validator(still, truth)[BEST_BY.removeprefix("val/")]
        error = record["validation"].get(BEST_BY)
        if error is not None and not error < rival:
            log.warning(
                "%s predicts the validation motions no better than constant velocity: "
                "error_windowed is %.3g, expected less than %.3g%s",
                *(record["name"], error, rival, "".join(f"; {text}" for text in reasons())),
            )


def prepare(plan: TrainingPlan, saved: Mapping[str, Any], batches: int) -> PreparedTraining:
    """Load the data, and build and check the model and its validation.

    Args:
        plan: the training.
        saved: content of the checkpoint that is resumed; empty for a new training.
        batches: steps of an epoch.
    """
    source, folder, config = plan.source, plan.folder, plan.config
    if saved:
        log.info("resuming in %s from step %d", folder, saved["global_step"])
    identity = same_data(source, folder, saved)
    if plan.stores_data:
        store(source, folder / TRAJECTORIES)
    if isinstance(source, LogSource):
        write_whole(folder / "log_report.md", source.report)
    torch.manual_seed(config["seed"])
    windows = build_data(plan.data, source, config["seed"], batches)
    with naming("data"):
        if warning := too_long_for(windows.splits.train, windows.step, source.labels):
            log.warning("%s: %s", source.name, warning)
        statistics = windows.statistics
    with naming("validator"):
        validator = plan.validator(training_step=statistics.step)
        validator.check(stack_until(windows.splits.validation), windows.splits.train)
    with naming("model"):
        built = plan.model
        model = built if isinstance(built, Predictor) else built(statistics=statistics)
        _check_windows(model, windows)
    known = model.known if isinstance(model, KnownAndNetwork) else model
    if isinstance(known, KnownMechanics):
        check_known(known, source)
    warn_of_log(known, source)
    if plan.start_from is not None and not saved:
        _take_weights(model, plan.start_from)
    facts = {"name": config["name"], "seed": config["seed"], "pairs": len(windows.windows)}
    record = saved.get(RECORD, {})
    return PreparedTraining(
        plan=plan,
        model=model,
        windows=windows,
        validator=validator,
        identity=identity,
        facts={**facts, **provenance()},
        start=time.perf_counter() - record.get("training_seconds", 0.0),
        processor_start=time.process_time() - record.get("processor_seconds", 0.0),
    )


def same_data(source: DataSource, folder: Path, saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return the identity of the data; refuse data other than those of the run in the folder."""
    log.info("%s: loading data", source.name)
    with naming("data"):
        identity = data_identity(source)
    require_same_data(folder, saved.get(DATA, {}), source.name, identity, REPLACE)
    return identity


def build_data(
    data: Callable[..., DynamicsData], source: DataSource, seed: int, batches: int
) -> DynamicsData:
    """Build the windows, with the seed of the training unless they have one."""
    seeds = {} if "seed" in getattr(data, "keywords", {}) else {"seed": seed}
    with naming("data"):
        return data(source=source, batches_per_epoch=batches, **seeds)


def _check_windows(model: Predictor, windows: DynamicsData) -> None:
    """Refuse windows without the momenta or the past that the model needs; warn of short ones."""
    if model.state == "qp" and windows.windows.p.shape[-1] == 0:
        raise ValueError(
            f"{windows.source.name} has no momenta p: set model.state=qv, or use model=lnn"
        )
    if model.input_history > windows.history:
        raise ValueError(
            f"the model uses {model.input_history} s before its start, but data.history is "
            f"{windows.history} s: set data.history={model.input_history}"
        )
    steps = len(windows.windows.t) - 1
    if model.history_steps > 20 * steps:
        log.warning(
            f"the model sees {model.history_steps} steps of {windows.step:g} s before windows of "
            f"{steps} steps: increase data.stride or data.steps, or reduce model.history"
        )


def _take_weights(model: Predictor, run: Run) -> None:
    trained = copy.deepcopy(run.model)
    set_output_limits(trained, {})
    if isinstance(model, KnownAndNetwork) and isinstance(trained, KnownMechanics):
        model = model.known
    try:
        model.load_state_dict(trained.state_dict())
    except RuntimeError as error:
        text = f"start_from: {run.folder} is of another model: {in_one_line(error)}"
        raise ConfigError(text) from error
    log.info("starting from the weights of %s", run.folder)
