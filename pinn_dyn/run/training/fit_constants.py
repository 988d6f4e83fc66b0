"""Training of physical constants: a least-squares fit in a run folder."""

from __future__ import annotations

import contextlib
import copy
import inspect
import logging
import signal
import statistics
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch.nn.utils import vector_to_parameters

from pinn_dyn import evaluation
from pinn_dyn.atomic_files import save_whole, write_whole
from pinn_dyn.data import DataSource, LogSource
from pinn_dyn.evaluation.metrics import validation_error
from pinn_dyn.evaluation.prediction import predict_trajectories
from pinn_dyn.evaluation.tables import units
from pinn_dyn.identification.constants import (
    CONSTANTS,
    common_factor,
    constants_table,
    contradicted,
    far_masses,
    undetermined,
    weak_joints,
)
from pinn_dyn.identification.rigid_excitation import rigid_excitation
from pinn_dyn.log_check.check import residual_figure
from pinn_dyn.mechanics import Predictor, Trajectory, double_copy, stack, stack_until
from pinn_dyn.models import KnownMechanics, LearnedConstants
from pinn_dyn.plots import save
from pinn_dyn.run.configuration.build import ConfigError, naming
from pinn_dyn.run.configuration.defaults import defaults, section
from pinn_dyn.run.run_folder import CHECKPOINTS, DATA, RECORD
from pinn_dyn.run.training.prepared import PreparedTraining, TrainingPlan, prepare
from pinn_dyn.training import COVARIANCE, FIT, Fit, LeastSquares
from pinn_dyn.wording import did_you_mean

log = logging.getLogger(__name__)

RESIDUALS = "residuals.png"
"""File of the figure of residual forces in a run folder."""
_SHOWN = 2  # directions in the log
_MOVE = "Move {} at more frequencies, poses and speeds. excite.py designs such a motion."
_NO_MOTION = (
    "Other constants act on the joints only in sums with further ones, or not at all. No motion "
    "determines them one by one, and no prediction depends on it. Their `known` in constants.csv "
    "is small."
)
_SCALE = (
    "The data determine all constants per drive gain only. Their common factor is held by the "
    "priors, to within a factor of {:.2g} (95 %). If the gains are known, set model.drive_gain and "
    "model.gain_spread=0. If a body is known, set a small prior for it, as "
    "'model.spread={{default: 3, {}: 0.01}}'."
)


def check_trainer(settings: Mapping[str, Any]) -> None:
    """Refuse settings that :class:`lightning.Trainer` does not have; warn that others are unused.

    A fit of constants has no trainer.
    """
    usual = section(defaults("", on_log=False), "trainer")
    changed = [key for key, x in settings.items() if x is not None and x != usual.get(key)]
    if not changed:  # without the import of Lightning
        return
    from lightning import Trainer

    names = list(inspect.signature(Trainer).parameters)
    for key in changed:
        if key not in names:
            hint = did_you_mean(key, names) or ": lightning.Trainer has no such argument"
            raise ConfigError(f"trainer has no key {key!r}{hint}")
    log.warning("least squares does not use trainer.%s", ", trainer.".join(changed))


def fit_constants(plan: TrainingPlan, solver: LeastSquares, saved: Mapping[str, Any]) -> None:
    """Fit the constants of a model, and write the run.

    The constants are saved between the stages of the fit and on an interrupt. The next call
    continues from them.

    Args:
        plan: the training. ``start_from`` is an earlier fit, whose covariance becomes the prior. Of
            the callbacks, only the figures of rollouts are used.
        solver: the least-squares solver.
        saved: content of the checkpoint of an interrupted fit; empty without one.

    Raises:
        ConfigError: if the parameters of the model are not physical constants, or the solver cannot
            use the data.
        KeyboardInterrupt: on an interrupt, from the SystemExit that ends the program.
    """
    training = prepare(plan, saved, batches=1)
    model, windows = training.model, training.windows
    truth = stack_until(windows.splits.validation)

    def keep(unfinished: Fit) -> None:
        _save("last", training, unfinished, training.record(0, {}))

    try:
        with naming("optimizer"), _sigterm_exits():
            result = _fitted(training, solver, truth, saved, keep)
    except (KeyboardInterrupt, SystemExit) as stop:
        raise KeyboardInterrupt from stop if isinstance(stop, SystemExit) else SystemExit(1)
    keep(result)
    with torch.no_grad():
        errors = training.validator(model.eval(), truth)
    metrics = {f"val/{name}": error for name, error in errors.items()}
    metrics["train/loss"] = result.residual**2
    left_out = _left_out_errors(training, result)
    record = training.record(1, metrics, stage=result.stage, left_out_errors=left_out)
    for name in ("best", "last"):
        _save(name, training, result, record)
    _write_log(training, truth, metrics)
    runs = windows.splits.train
    write_constants(model, result, windows.source, training.plan.folder, runs, solver.cutoff)
    if isinstance(model, KnownMechanics) and isinstance(windows.source, LogSource):
        figure = residual_figure(windows.source, double_copy(model).structure)
        if figure is not None:
            save(figure, training.plan.folder / RESIDUALS)
    assert isinstance(model, LearnedConstants)
    training.finish(record, partial(weak_joints, model, runs, solver.cutoff, windows.source.labels))


def _left_out_errors(training: PreparedTraining, result: Fit) -> list[float]:
    """Return the mean error on each training run of a fit without it, as in the validation."""
    if result.left_out is None:
        return []
    validator, model, errors = training.validator, copy.deepcopy(training.model), []
    window, step = validator.window or validator.horizon, validator.step
    for z, run in zip(result.left_out, training.windows.splits.train, strict=True):
        if run.duration < window:
            continue
        vector_to_parameters(z.float(), model.parameters())
        prediction = predict_trajectories(model, stack([run]), window=window, step=step)
        errors.append(float(prediction.error().mean()))
    if errors:
        text = "fits without one of %d runs: error on that run %.3g on average, %.3g to %.3g"
        log.info(text, len(errors), statistics.fmean(errors), min(errors), max(errors))
    return errors


def _fitted(
    training: PreparedTraining,
    solver: LeastSquares,
    truth: Trajectory,
    saved: Mapping[str, Any],
    keep: Callable[[Fit], None],
) -> Fit:
    """Fit the model, or continue the interrupted fit of a checkpoint."""
    model, data, result = training.model, training.windows, None
    if not isinstance(model, LearnedConstants):
        raise TypeError(
            "least squares fits physical constants (model=known or known_system), not "
            f"{type(model).__name__}: use optimizer=adamw"
        )
    if saved:
        model.load_state_dict({k.removeprefix("model."): x for k, x in saved["state_dict"].items()})
    if FIT in saved:
        result = Fit.from_state(saved[FIT], sum(p.numel() for p in model.parameters()))
    if result is not None and result.stopped_in is None:
        return result
    start_from = training.plan.start_from
    covariance = None if start_from is None else start_from.covariance
    if start_from is not None and covariance is None:
        raise ConfigError("start_from: the run has no covariance of its constants")
    errors = torch.no_grad()(partial(training.validator.part_errors, truth=truth))
    return solver.fit(model, data.splits.train, data.windows, covariance, result, errors, keep)


@contextlib.contextmanager
def _sigterm_exits() -> Iterator[None]:
    """Raise SystemExit on SIGTERM within a context, in the main thread."""
    if threading.current_thread() is not threading.main_thread():  # which alone receives signals
        yield
        return
    before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _save(name: str, training: PreparedTraining, result: Fit, record: dict[str, Any]) -> None:
    """Write a checkpoint with the entries that :func:`~.run_folder.load_run` reads."""
    statistics = training.windows.statistics.to_dict()
    content = {
        "state_dict": {f"model.{key}": x for key, x in training.model.state_dict().items()},
        "hyper_parameters": {"config": training.plan.config, "statistics": statistics},
        "global_step": record["steps"],
        COVARIANCE: result.covariance,
        FIT: result.state(),
        RECORD: record,
        DATA: training.identity,
    }
    path = training.plan.folder / CHECKPOINTS / f"{name}.ckpt"
    path.parent.mkdir(exist_ok=True)
    save_whole(path, content)


def _write_log(
    training: PreparedTraining,
    truth: Trajectory,
    metrics: dict[str, float],
) -> None:
    """Log metrics, and to TensorBoard settings and the figures of rollouts."""
    from torch.utils.tensorboard import SummaryWriter  # takes half a second

    callbacks, loggers = training.plan.callbacks, training.plan.loggers
    # Without callbacks, the module of the figures and Lightning are not imported.
    draws = [isinstance(x, evaluation.RolloutFigures) for x in callbacks or ()]
    figures = {}
    if callbacks is None or any(draws):
        figures = training.validator.figures(training.model, training.windows.source, truth)
    for logger in loggers or ():
        logger.log_metrics(metrics, 0)
    writers = [getattr(logger, "experiment", None) for logger in loggers or ()]
    boards = [writer for writer in writers if isinstance(writer, SummaryWriter)]
    if loggers is None:
        boards = [SummaryWriter(str(training.plan.folder / "tensorboard"))]
        for name, value in metrics.items():
            boards[0].add_scalar(name, value, 0)
    for board in boards:
        error = {"hp/validation_error": validation_error(metrics)}
        board.add_hparams(training.compared_settings(), error, run_name=".", global_step=0)
        for name, figure in figures.items():
            board.add_figure(name, figure, 0)
        board.close()
    for logger in loggers or ():
        logger.finalize("success")


def write_constants(
    model: Predictor,
    result: Fit,
    source: DataSource,
    folder: Path,
    runs: Sequence[Trajectory],
    cutoff: float,
) -> None:
    """Write the constants with 95 % intervals, and the ones that the data do not determine.

    The motions ``runs``, filtered at ``cutoff`` Hz, determine the same combinations of the
    constants of rigid bodies as in the check of a log.
    """
    assert isinstance(model, LearnedConstants)
    table = constants_table(model, result, [units([label]) for label in source.input_labels])
    path = folder / CONSTANTS
    write_whole(path, table.to_csv(index=False, float_format="%.4g"))
    log.info("constants and their intervals are in %s", path)
    remarks = []
    if isinstance(model, KnownMechanics):
        excitation = rigid_excitation(double_copy(model).structure, runs, cutoff=cutoff)
        lines = [x for x in excitation.undetermined.split("; ") if x != "none"]
        head = (
            f"{len(lines)} of {excitation.count} base parameters are not determined by the motions"
        )
        if lines:
            remarks.append(_MOVE.format(", ".join(excitation.open_joints)))
        remarks.append(_NO_MOTION)
        if model.gain is not None:
            body = model.structure.body_names[-1]
            remarks.append(_SCALE.format(common_factor(model, result), body))
    else:
        lines = undetermined(model, result)
        head = f"{len(lines)} of {len(table)} directions of the constants are held by the prior"
    conflicts = contradicted(model, result)
    if isinstance(model, KnownMechanics) and not result.prior.mean.any():
        conflicts += far_masses(table)
    path = folder / "undetermined.md"
    parts = [f"{head}.", "\n".join(f"- {x}" for x in lines), *conflicts, *remarks]
    write_whole(path, "\n\n".join(filter(None, parts)) + "\n")
    if lines:
        log.warning("%s, see %s: %s ...", head, path, "; ".join(lines[:_SHOWN]))
    for text in conflicts:
        log.warning(text)
