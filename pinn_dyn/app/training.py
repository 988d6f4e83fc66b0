"""Train a model, as train.py does."""

from __future__ import annotations

import json
import logging
import time
from pathlib import Path

import lightning as L
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pinn_dyn.app.build import (
    build_data,
    build_learner,
    build_model,
    build_trainer,
    build_validator,
)
from pinn_dyn.app.config import ConfigError, plain
from pinn_dyn.app.runs import CHECKPOINTS, METRICS, provenance, read_config, write_config
from pinn_dyn.data import LogSource
from pinn_dyn.evaluation import cleaning_figure, save
from pinn_dyn.evaluation.sweep_table import flatten

log = logging.getLogger(__name__)


def train(cfg: DictConfig) -> float:
    """Train one model; returns the last validation error, the figure that a sweep minimizes.

    Raises:
        ConfigError: on a configuration that cannot be used, or nothing to resume from.
        NonFiniteLossError: if the loss becomes NaN or infinite.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    last = None
    if cfg.resume is not None:
        others = [word for word in HydraConfig.get().overrides.task if word[:7] != "resume="]
        if others:
            raise ConfigError(
                f"resume goes on with the run's own configuration: leave out {', '.join(others)}"
            )
        folder = Path(cfg.resume)
        config = read_config(folder)
        last = folder / CHECKPOINTS / "last.ckpt"
        if not last.is_file():
            raise ConfigError(f"nothing to resume from: {last} does not exist")
    else:
        config = plain(cfg)
        write_config(folder, config)
    torch.set_num_threads(config["threads"])
    L.seed_everything(config["seed"], verbose=False)

    data = build_data(config)
    log.info("%s: loading data", config["name"])
    try:
        statistics = data.statistics
    except ValueError as problem:
        raise ConfigError(f"data: {problem}") from problem
    if isinstance(data.source, LogSource):
        _write_report(data.source, folder)
    validator = build_validator(config, statistics.step)
    try:
        data.splits.validation[0].until(validator.horizon)
    except ValueError as problem:
        raise ConfigError(f"validator: {problem}") from problem
    model = build_model(config, statistics)
    if model.coordinates == "momentum" and data.windows.p.shape[-1] == 0:
        raise ConfigError(
            f"model: {config['model_name']} learns from momenta p = M(q) v, and the data set "
            f"{data.source.name} has none, as they cannot be measured: set "
            "model.coordinates=velocity, which learns from (q, v), or use model=lnn"
        )
    learner = build_learner(config, model, statistics, validator)
    trainer = build_trainer(config, folder, data.source, validator)

    start, start_cpu = time.perf_counter(), time.process_time()
    try:
        trainer.fit(learner, data, ckpt_path=last, weights_only=True)
    except SystemExit:  # Lightning's end of an interrupted training
        log.warning("interrupted; go on with: python train.py resume=%s", folder)
        raise
    seconds = time.perf_counter() - start

    metrics = {key: float(value) for key, value in trainer.callback_metrics.items()}
    error = metrics.get("val/error_mean", float("nan"))
    parameters = sum(p.numel() for p in model.parameters())
    record = {
        "name": config["name"],
        "seed": config["seed"],
        "pairs": len(data.windows),
        "parameters": parameters,
        "training_seconds": seconds,
        "training_cpu_seconds": time.process_time() - start_cpu,
        "steps": trainer.global_step,
        "validation": metrics,
        **provenance(),
    }
    (folder / METRICS).write_text(json.dumps(record, indent=2))
    for logger in trainer.loggers:
        logger.log_hyperparams(
            flatten(config),
            {"val/error_mean": error, "training_seconds": seconds},
        )
        logger.finalize("success")
    log.info(
        "%s seed %d: validation error %.5f over %g s after %.0f s of training, in %s",
        config["name"],
        config["seed"],
        error,
        validator.horizon,
        seconds,
        folder,
    )
    return error


def _write_report(source: LogSource, folder: Path) -> None:
    """Write what the cleaning of a log did, and a picture of it."""
    (folder / "log_report.md").write_text(source.report)
    figure = cleaning_figure(
        source.cleaned[0],
        title=f"{source.name}, raw and cleaned",
        labels=source.labels,
        input_labels=source.input_labels,
    )
    save(figure, folder / "log_cleaning.png")
    log.info("what was done to the log is in %s and log_cleaning.png", folder / "log_report.md")
