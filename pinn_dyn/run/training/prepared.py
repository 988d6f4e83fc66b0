"""Model and data of a training, built and checked."""

from __future__ import annotations

import copy
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

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

_COMPARED = ("model_name", "seed", "dataset.name", "data.", "model.", "optimizer.", "trainer.steps")
"""Beginnings of the settings that TensorBoard shows beside the validation error."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PreparedTraining:
    """Model and data of a training in a run folder.

    Attributes:
        model: the model, with the weights to start from.
        windows: training windows and validation trajectories.
        validator: errors of rollouts.
        config: description of the run.
        identity: identity of the data.
        facts: name, seed, windows, software and hardware, for the record.
        folder: the run folder.
        start, processor_start: times at which the training started, without interruptions, of the
            clock and of the processor, s.
    """

    model: Predictor
    windows: DynamicsData
    validator: RolloutValidator
    config: dict[str, Any]
    identity: dict[str, Any]
    facts: dict[str, Any]
    folder: Path
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
        flat = flattened(self.config)
        settings = {key: value for key, value in flat.items() if key.startswith(_COMPARED)}
        return {key: x if isinstance(x, (int, float)) else str(x) for key, x in settings.items()}

    def finish(self, record: dict[str, Any], reasons: Callable[[], Sequence[str]] = tuple) -> None:
        """Write the record of the last step, completed by the score of the model that is kept.

        A warning names a model that predicts no better than constant velocity, with the reasons.
        """
        record = finish(self.folder, record)
        log.info(
            "%s seed %d: validation error over %s %s, after %.0f s of training, in %s",
            *(record["name"], record["seed"], self.validator, score(record)),
            *(record["training_seconds"], self.folder),
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


def prepare(
    *,
    source: DataSource,
    model: ModelBuilder | Predictor,
    saved: Mapping[str, Any],
    start_from: Run | None,
    data: Callable[..., DynamicsData],
    validator: Callable[..., RolloutValidator],
    batches: int,
    config: dict[str, Any],
    folder: Path,
    stores: bool,
) -> PreparedTraining:
    """Load the data, and build and check the model and its validation.

    Args:
        source: the data.
        model: the model, or its builder.
        saved: content of the checkpoint that is resumed; empty for a new training.
        start_from: a run whose weights a new training starts from.
        data: builder of the windows.
        validator: builder of the validation.
        batches: steps of an epoch.
        config: description of the run.
        folder: the run folder.
        stores: true to store the trajectories in the folder.
    """
    if saved:
        log.info("resuming in %s from step %d", folder, saved["global_step"])
    identity = same_data(source, folder, saved)
    if stores:
        store(source, folder / TRAJECTORIES)
    if isinstance(source, LogSource):
        write_whole(folder / "log_report.md", source.report)
    torch.manual_seed(config["seed"])
    windows = build_data(data, source, config["seed"], batches)
    with naming("data"):
        if warning := too_long_for(windows.splits.train, windows.step, source.labels):
            log.warning("%s: %s", source.name, warning)
        statistics = windows.statistics
    with naming("validator"):
        rollouts = validator(training_step=statistics.step)
        rollouts.check(stack_until(windows.splits.validation), windows.splits.train)
    with naming("model"):
        predictor = model if isinstance(model, Predictor) else model(statistics=statistics)
        _check_windows(predictor, windows)
    known = predictor.known if isinstance(predictor, KnownAndNetwork) else predictor
    if isinstance(known, KnownMechanics):
        check_known(known, source)
    warn_of_log(known, source)
    if start_from is not None and not saved:
        _take_weights(predictor, start_from)
    facts = {"name": config["name"], "seed": config["seed"], "pairs": len(windows.windows)}
    return PreparedTraining(
        model=predictor,
        windows=windows,
        validator=rollouts,
        config=config,
        identity=identity,
        facts={**facts, **provenance()},
        folder=folder,
        start=time.perf_counter() - saved.get(RECORD, {}).get("training_seconds", 0.0),
        processor_start=time.process_time() - saved.get(RECORD, {}).get("processor_seconds", 0.0),
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
