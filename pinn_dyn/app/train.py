"""The command train.py."""

from __future__ import annotations

import logging
import signal
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from pinn_dyn.app.config import checked
from pinn_dyn.app.sweep import resume_command
from pinn_dyn.atomic_files import write_whole
from pinn_dyn.evaluation.metrics import validation_error
from pinn_dyn.run.configuration.build import ConfigError, build_part, build_source, model_builder
from pinn_dyn.run.configuration.trust import check_name, packages, require_trusted
from pinn_dyn.run.run_folder import (
    CHECKPOINTS,
    load_run,
    newest_checkpoint,
    read_checkpoint,
    require_no_links_out,
)
from pinn_dyn.run.training import train as training
from pinn_dyn.run.training.trainer import tensorboard

log = logging.getLogger(__name__)

_RESUME = ("resume=", "trust=")


def train(cfg: DictConfig) -> float:
    """Train one model; return the validation error of the kept model, which a sweep minimizes.

    A folder that holds this training is not trained again: a finished training is loaded, an
    interrupted one is resumed.
    """
    folder = Path(HydraConfig.get().runtime.output_dir)
    trust = packages(cfg.get("trust"))
    if cfg.get("resume") is not None:
        folder = Path(cfg.resume)
        config = _recorded(folder, trust)
    else:
        config = checked("train", cfg)
        check_name("model_name", config["model_name"])  # files are named by it
        check_name("dataset.name", config["dataset"].get("name", "data"))
    start, payload = config.get("start_from"), config.pop("payload", None)
    overwrite = config.pop("overwrite", False)
    try:
        run = training.train(
            **training_arguments(config, folder),
            start_from=None if start is None else load_run(Path(start), "best", trust),
            folder=folder,
            overwrite=overwrite,
            config=config,
        )
    except KeyboardInterrupt as interrupt:
        stop = interrupt.__context__ and interrupt.__context__.__cause__
        if not isinstance(stop, SystemExit):
            raise
        job, way = HydraConfig.get(), f"resume with: {resume_command(folder)}"
        if not (folder / CHECKPOINTS / "last.ckpt").is_file():
            way = "nothing is saved yet, start again with the same command"
        if job.mode == RunMode.MULTIRUN:
            way = f"go on with the same command and hydra.sweep.dir={job.sweep.dir}"
        log.warning("interrupted; %s", way)
        raise SystemExit(stop.code or 128 + signal.SIGTERM) from interrupt
    if payload is not None:
        load = run.identify_payload(payload)
        write_whole(folder / "payload.csv", load.to_csv(index=False, float_format="%.4g"))
        text = load.to_string(index=False, na_rep="", float_format="{:.4g}".format)
        print(f"Load in the frame of {load.attrs['frame']}, inertia about its center:\n{text}")
    return validation_error(run.metrics["validation"])


def training_arguments(config: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Build the arguments of :func:`~pinn_dyn.train` from the configuration of train.py."""
    optimizer = config["optimizer"]
    settings = {k: x for k, x in config["trainer"].items() if not k.startswith("_")}
    builders = ("data", "loss", "scheduler", "validator")
    return {
        "source": build_source(config),
        "model": model_builder(config),
        **{name: build_part(name, config[name], partial_=True) for name in builders},
        "optimizer": build_part("optimizer", optimizer, partial_=optimizer.get("_partial_", False)),
        "steps": settings.pop("steps"),
        "validations": settings.pop("validations"),
        "trainer": settings,
        "callbacks": [
            build_part(f"callbacks.{name}", part)
            for name, part in config["callbacks"].items()
            if part is not None
        ],
        "loggers": [
            tensorboard(folder)
            if name == "tensorboard"
            else build_part(f"logger.{name}", part, save_dir=str(folder))
            for name, part in config["logger"].items()
        ],
        **{name: config[name] for name in ("seed", "compile", "threads")},
    }


def _recorded(folder: Path, trust: tuple[str, ...]) -> dict[str, Any]:
    overrides = HydraConfig.get().overrides.task
    if ignored := [word for word in overrides if not word.lstrip("+").startswith(_RESUME)]:
        raise ConfigError(
            f"resume uses the configuration of the run: leave out {', '.join(ignored)}"
        )
    require_no_links_out(folder)
    path, saved = newest_checkpoint(folder)
    if path is None:
        saved = read_checkpoint(path := folder / CHECKPOINTS / "last.ckpt")  # says what is wrong
    config = saved["hyper_parameters"]["config"]
    require_trusted(config, str(path), trust)
    return checked("train", config)
