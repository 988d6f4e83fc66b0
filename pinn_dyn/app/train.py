"""Train a model, as train.py does."""

from __future__ import annotations

import logging
import signal
from pathlib import Path
from typing import Any

import lightning as L
import torch
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from pinn_dyn.app.build import (
    VALIDATION_ERROR,
    build_data,
    build_learner,
    build_predictor,
    build_trainer,
    build_validator,
    check_processes,
    epochs,
    require_compiler,
    require_device,
)
from pinn_dyn.app.config import ConfigError, check, checked
from pinn_dyn.app.constants import write_constants
from pinn_dyn.app.data_record import check_data, write_data
from pinn_dyn.app.keys import KEYS
from pinn_dyn.app.known_data import check_known
from pinn_dyn.app.parts import build_part
from pinn_dyn.app.provenance import provenance
from pinn_dyn.app.run_folder import (
    CHECKPOINTS,
    CONFIG,
    METRICS,
    claimed,
    load_run,
    read_checkpoint,
    read_config,
    recorded_error,
    require_same,
    write_json,
)
from pinn_dyn.app.schema import check_value
from pinn_dyn.app.settings import Cell, flatten
from pinn_dyn.app.trust import check_name, packages
from pinn_dyn.data import DataSource, LogSource
from pinn_dyn.data.fastest_motion import too_long_for
from pinn_dyn.data.whole import write_whole
from pinn_dyn.ensembles import Ensemble, EnsembleData
from pinn_dyn.evaluation import RunDescription, ValidationHistory, cleaning_figure, save
from pinn_dyn.mechanics import Predictor, stack_until
from pinn_dyn.models import KnownAndNetwork, KnownMechanics
from pinn_dyn.models.output_limits import set_output_limits
from pinn_dyn.training import COVARIANCE, LeastSquaresLearner

log = logging.getLogger(__name__)

_OVERRIDES = Path(".hydra") / "overrides.yaml"

# Compared among all runs, chosen on the command line or not.
_ALWAYS = (
    "seed",
    "data.pairs",
    "data.steps",
    "data.stride",
    "data.batch_size",
    "optimizer.lr",
    "trainer.steps",
)
# Not about what is learned.
_IGNORED = ("callbacks", "logger", "name", "model_name", "threads", "resume")


def train(cfg: DictConfig) -> float:
    """Train one model; returns the last validation error, the figure that a sweep minimizes.

    A folder that holds this very training already is not trained again: a finished one is passed
    over, one that was interrupted goes on.

    Raises:
        ConfigError: on a configuration that cannot be used, a folder that holds another training,
            nothing to resume from, or data that have changed since.
        NonFiniteLossError: if the loss becomes NaN or infinite.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    name = cfg.get("resume_from") or "last"
    if cfg.get("resume") is None:
        config = checked("train", cfg)
        check_name("model_name", config["model_name"])  # as who reads the run will
        if "name" in config["dataset"]:
            check_name("dataset.name", config["dataset"]["name"])
        if config.get("search"):
            config = build_part("search", config["search"]).applied(config)
        if config.get("resume_from"):
            raise ConfigError("resume_from says from which checkpoint: give resume=<run> with it")
        trust = packages(config.get("trust"))
    else:
        folder, trust = Path(cfg.resume), packages(cfg.get("trust"))
        others = [
            word
            for word in HydraConfig.get().overrides.task
            if not word.lstrip("+").startswith(("resume=", "resume_from=", "trust="))
        ]
        if others:
            raise ConfigError(
                f"resume goes on with the run's own configuration: leave out {', '.join(others)}"
            )
        check_value("resume_from", name, KEYS["train"]["resume_from"])
        config = read_config(folder, trust)
        epochs(config)  # an old run says so
        check("train", config)
    checkpoint = folder / CHECKPOINTS / f"{name}.ckpt"
    if cfg.get("resume") is not None and not checkpoint.is_file():
        raise ConfigError(f"nothing to resume from: {checkpoint} does not exist")
    with claimed(folder, config):
        error = recorded_error(folder)
        if error is not None and cfg.get("resume") is None:
            log.info("already trained, to train again delete %s", folder)
            return error
        try:
            return train_in(folder, config, _whole(folder, checkpoint, trust), trust)
        except SystemExit as stop:  # Lightning's end of an interrupted training
            if HydraConfig.get().mode == RunMode.RUN:
                log.warning("interrupted; go on with: python train.py resume=%s", folder)
            # SIGTERM has no status.
            raise SystemExit(stop.code or 128 + signal.SIGTERM) from stop


def _whole(folder: Path, checkpoint: Path, trust: tuple[str, ...] = ()) -> Path | None:
    """The checkpoint that the training of a folder goes on from; None if it starts anew.

    Raises:
        ConfigError: if the checkpoint is damaged; says from which other one to go on. Also if it
            is of another training.
    """
    if not checkpoint.is_file():
        return None
    try:
        step = _step(checkpoint)
    except ConfigError as error:
        best = checkpoint.with_name("best.ckpt")
        try:
            step = _step(best)
        except ConfigError:
            raise ConfigError(
                f"{error}\n{best} is no better: delete {folder} and train again"
            ) from error
        raise ConfigError(
            f"{error}\nGo on from the best checkpoint, of step {step}, with: python train.py "
            f"resume={folder} resume_from=best"
        ) from error
    saved = read_checkpoint(checkpoint)["hyper_parameters"]["config"]
    require_same(checkpoint, saved, folder, read_config(folder, trust))
    log.info("going on with the training in %s from step %d", folder, step)
    return checkpoint


def _step(checkpoint: Path) -> int:
    """The training step of a checkpoint that holds all that a training needs to go on."""
    saved = read_checkpoint(checkpoint)
    if missing := [key for key in ("global_step", "loops", "optimizer_states") if key not in saved]:
        raise ConfigError(f"{checkpoint} has no {', '.join(missing)}: it holds weights alone")
    return saved["global_step"]


def train_in(
    folder: Path,
    config: dict[str, Any],
    last: Path | None = None,
    trust: tuple[str, ...] = (),
    source: DataSource | None = None,
) -> float:
    """Train in a folder that is claimed, and write the record; returns the last validation error.

    Args:
        folder: the run folder.
        config: the resolved configuration.
        last: the checkpoint to go on from, if any.
        trust: packages whose classes the run of ``start_from`` may build.
        source: the data; None builds those of ``config["dataset"]``.

    Raises:
        ConfigError: on data, or a model, that do not fit together, or if there is no compiler.
        NonFiniteLossError: if the loss becomes NaN or infinite.
        SystemExit: if it was interrupted.
    """
    torch.set_num_threads(config["threads"])
    L.seed_everything(config["seed"], verbose=False)

    require_device(config)  # before the data are simulated
    require_compiler(config)
    data = build_data(config, source)
    log.info("%s: loading data", config["name"])
    try:
        if long := too_long_for(data.splits.train, data.step, data.source.labels):
            log.warning("%s: %s", data.source.name, long)
        statistics = data.statistics
    except ValueError as problem:
        raise ConfigError(f"data: {problem}") from problem
    if last is None:
        write_data(folder, data.source)
    else:
        check_data(folder, data.source)
    if isinstance(data.source, LogSource):
        _write_report(data.source, folder)
    validator = build_validator(config, statistics.step)
    try:
        validator.check(stack_until(data.splits.validation))
    except ValueError as problem:
        raise ConfigError(f"validator: {problem}") from problem
    check_known(config, data.source)
    model = build_predictor(config, statistics)
    if model.state == "qp" and data.windows.p.shape[-1] == 0:
        raise ConfigError(
            f"model: {config['model_name']} learns from momenta p = M(q) v, and the data set "
            f"{data.source.name} has none, as they cannot be measured: set "
            "model.state=qv, which learns from (q, v), or use model=lnn"
        )
    if model.input_history > data.history:
        raise ConfigError(
            f"data.history is {data.history} s, but the model may look {model.input_history} s back"
            " (model.delay.longest): leave data.history out, it follows model.delay.longest"
        )
    if config.get("start_from") is not None and last is None:
        _take_weights(model, Path(config["start_from"]), trust)
    learner = build_learner(config, model, statistics, validator)
    if isinstance(learner, LeastSquaresLearner) and config.get("start_from") is not None:
        saved = read_checkpoint(Path(config["start_from"]) / CHECKPOINTS / "best.ckpt")
        if not isinstance(saved.get(COVARIANCE), torch.Tensor):
            raise ConfigError(
                f"start_from: {config['start_from']} has no covariance of its constants, which a "
                "fit by optimizer=least_squares leaves: fit it again, or leave start_from out"
            )
        learner.covariance = saved[COVARIANCE]
    description = describe(folder, config)
    trainer = build_trainer(config, folder, data.source, validator, description)
    check_processes(trainer, config["data"]["batch_size"])
    batches = EnsembleData(data, model.size) if isinstance(model, Ensemble) else data

    try:
        trainer.fit(learner, batches, ckpt_path=last, weights_only=True)
    except ValueError as problem:
        if isinstance(learner, LeastSquaresLearner):  # settings that only the data can refuse
            raise ConfigError(f"optimizer: {problem}") from problem
        raise
    except SystemExit:  # Lightning's end of an interrupted training
        if isinstance(learner, LeastSquaresLearner) and learner.result is not None:
            trainer.save_checkpoint(folder / CHECKPOINTS / "last.ckpt")
            write_constants(model, learner.result, data.source, folder)
        raise
    if last is not None and not trainer.callback_metrics:  # ended just before its record
        trainer.validate(learner, batches, verbose=False)
    seconds, cpu_seconds = description.seconds
    if isinstance(learner, LeastSquaresLearner) and learner.result is not None:
        write_constants(model, learner.result, data.source, folder)

    metrics = {key: float(value) for key, value in trainer.callback_metrics.items()}
    error = metrics.get(VALIDATION_ERROR, float("nan"))
    parameters = sum(p.numel() for p in model.parameters())
    record = {
        "name": config["name"],
        "seed": config["seed"],
        "pairs": len(data.windows),
        "parameters": parameters,
        "training_seconds": seconds,
        "training_cpu_seconds": cpu_seconds,
        "steps": trainer.global_step or _saved_steps(folder),
        "validation": metrics,
        **provenance(),
    }
    write_json(folder / METRICS, record)
    histories = [one for one in trainer.callbacks if isinstance(one, ValidationHistory)]  # type: ignore[attr-defined]
    log.info(
        "%s seed %d: validation error %.5f over %s after %.0f s of training, in %s%s%s",
        config["name"],
        config["seed"],
        error,
        validator,
        seconds,
        folder,
        "".join(f"; {one.summary()}" for one in histories),
        "".join(f"; {key} {value:.4g}" for key, value in model.learned_figures().items()),
    )
    for one in histories:
        if said := one.warning():
            log.warning("%s", said)
    return error


def _take_weights(model: Predictor, folder: Path, trust: tuple[str, ...]) -> None:
    """Give the model the trained weights, and the scales, of another run."""
    try:
        trained = load_run(folder, "best", trust).model
    except ConfigError as error:
        raise ConfigError(f"start_from: {error}") from error
    set_output_limits(trained, {})
    if isinstance(model, KnownAndNetwork) and isinstance(trained, KnownMechanics):
        model = model.known
    here, there = ({k: tuple(x.shape) for k, x in m.state_dict().items()} for m in (model, trained))
    other = [key for key in {**here, **there} if here.get(key) != there.get(key)]
    if other:
        shown = [f"{k} is {here.get(k, 'absent')}, there {there.get(k, 'absent')}" for k in other]
        raise ConfigError(
            f"start_from: the run {folder} trained another model than this configuration has, "
            f"expected the same classes and sizes: {'; '.join(shown[:3])}"
            f"{f'; and {len(shown) - 3} more' if len(shown) > 3 else ''}"
        )
    model.load_state_dict(trained.state_dict())
    log.info("starting from the weights of %s", folder)


def _saved_steps(folder: Path) -> int:
    """Training steps of other processes, whose trainers counted them."""
    path = folder / CHECKPOINTS / "last.ckpt"
    return torch.load(path, weights_only=True)["global_step"] if path.is_file() else 0


def _write_report(source: LogSource, folder: Path) -> None:
    """Write what the cleaning of a log did, and a picture of it."""
    write_whole(folder / "log_report.md", source.report)
    figure = cleaning_figure(
        source.cleaned[0],
        title=f"{source.name}, raw and cleaned",
        labels=source.labels,
        input_labels=source.input_labels,
    )
    save(figure, folder / "log_cleaning.png")
    log.info("what was done to the log is in %s and log_cleaning.png", folder / "log_report.md")


def describe(folder: Path, config: dict[str, Any]) -> RunDescription:
    """The description of the run in a folder."""
    path = folder / _OVERRIDES
    overrides = yaml.safe_load(path.read_text()) if path.is_file() else []
    return RunDescription(
        settings=run_settings(config, overrides),
        configuration=(folder / CONFIG).read_text(encoding="utf-8"),
        provenance=provenance(),
    )


def run_settings(config: dict[str, Any], overrides: list[str]) -> dict[str, Cell]:
    """The settings to compare with those of other runs.

    The whole configuration has some hundred values that hardly ever differ. So these are: model,
    data set, the usual ones, and every value or group that was given on the command line, in a
    sweep too, such as ``model.integrator.substeps=2`` and ``model/damping=constant``.
    """
    flat = flatten(config)
    settings = {
        "model": flat["model_name"],
        "dataset": flat["dataset.name"],
        "loss": flat["loss._target_"],
        **{key: flat[key] for key in _ALWAYS if key in flat},
    }
    for override in overrides:
        key, _, value = override.lstrip("+").partition("=")
        # The draw of a search is a setting; what it may draw is not.
        if key.startswith("search") and key != "search.draw":
            continue
        if not key.startswith("~") and key.split(".")[0] not in _IGNORED:
            settings.setdefault(key, flat.get(key, value))
    return settings
