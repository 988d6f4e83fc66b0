"""Comparison of trained models on trajectories that no training saw, as evaluate.py does it."""

from __future__ import annotations

import glob
import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pinn_dyn.app.config import ConfigError, checked
from pinn_dyn.app.constants import read_constants
from pinn_dyn.app.identification import identified
from pinn_dyn.app.provenance import write_provenance
from pinn_dyn.app.run import Run
from pinn_dyn.app.run_folder import CONFIG, check_data, load_run
from pinn_dyn.app.shared_data import RunData, shared_data
from pinn_dyn.app.trust import packages
from pinn_dyn.data.fastest_motion import too_long_for
from pinn_dyn.evaluation import (
    Entry,
    Evaluation,
    build_baselines,
    common_stride,
    default_horizon,
    default_windows,
    evaluate_models,
    model_names,
)
from pinn_dyn.mechanics import stack_until

log = logging.getLogger(__name__)

THRESHOLDS = {"small": 0.01, "large": 0.1}
"""Thresholds of the valid prediction times, in the units of q."""
_COLUMNS = ("pairs", "parameters", "training_seconds", "training_cpu_seconds")


def evaluate(
    runs: Sequence[Run],
    *,
    dataset: Mapping[str, Any] | None = None,
    split: str = "test",
    horizon: float | None = None,
    step: float | None = None,
    windows: Sequence[float] | None = None,
    thresholds: Mapping[str, float] = THRESHOLDS,
) -> Evaluation:
    """Compare trained models on the same test trajectories, beside the baselines.

    Args:
        runs: loaded runs that were trained on the same data.
        dataset: configuration of another data set to test on; None takes that of the training.
        split: ``test``, or ``validation`` for choosing settings.
        horizon: length of the rollouts, s; None takes the shortest trajectory, 5 s at most.
        step: step of the rollouts, s; None takes the training step of each run.
        windows: times between two resets to the measured state, s, one windowed error each; None
            takes those of 0.1, 0.5 and 1 s that fit.
        thresholds: names and values of the valid prediction times, in the units of q.

    Raises:
        ValueError: if the runs were trained on different data, if the data have changed since, or
            if the settings do not fit the data.
    """
    data = shared_data(runs, {"dataset": dataset, "split": split})
    for run, item in zip(runs, data, strict=True):
        check_data(run, item.trained_on)
    plain = next(k for k, item in enumerate(data) if not item.preparation)
    source, motions = data[plain].source, data[plain].trajectories
    horizon = horizon or default_horizon(stack_until(motions).duration)
    truths = [stack_until(item.trajectories, horizon) for item in data]
    truth = truths[plain]
    if len(truth.q) < len(motions):
        log.warning(
            "%d of %d trajectories of %s are shorter than horizon=%g and left out",
            *(len(motions) - len(truth.q), len(motions), source.name, horizon),
        )
    steps = [run.model.fixed_step or step or run.statistics.step for run in runs]
    if message := too_long_for(motions, max(steps), source.labels):
        log.warning("%s: %s", source.name, message)
    stride = common_stride(steps, truth.t)
    grid = stride * truth.duration / (len(truth.t) - 1)
    windows = default_windows(horizon, grid) if windows is None else windows

    models = [
        f"{run.config['model_name']} {item.preparation}".rstrip()
        for run, item in zip(runs, data, strict=True)
    ]
    models = model_names(models, [run.config for run in runs])
    names = _run_names(runs, models)
    entries = []
    for k, run in enumerate(runs):
        figures = {name: run.metrics[name] for name in _COLUMNS if name in run.metrics}
        figures |= {"folder": str(run.folder), **run.model.learned_figures()}
        entries.append(
            Entry(
                names[k],
                run.model,
                truths[k],
                data[k].training,
                steps[k],
                models[k],
                seed=run.config["seed"],
                figures=figures,
                members=run.ensemble,
            )
        )
    training = data[plain].training
    predictors = build_baselines(training.train, training.validation, step=grid)
    baselines = [Entry(k, x, truth, training, grid, k) for k, x in predictors.items()]
    for k, model in identified(runs, data).items():
        name = f"identification of {names[k]}"
        baselines.append(Entry(name, model, truths[k], data[k].training, steps[k], name))
    evaluation = evaluate_models(
        entries,
        baselines,
        source,
        split=split,
        stride=stride,
        windows=windows,
        thresholds=thresholds,
    )
    evaluation.constants = read_constants(
        {name: run.folder for name, run in zip(names, runs, strict=True)}
    )
    evaluation.notes = _notes(data, source.name)
    return evaluation


def _run_names(runs: Sequence[Run], models: Sequence[str]) -> list[str]:
    """Return short names: the model, with seed and folder where these tell runs apart."""
    pairs = zip(runs, models, strict=True)
    seeds = [f"{name} seed {run.config['seed']}" for run, name in pairs]
    for names in (models, seeds):
        if len(set(names)) == len(names):
            return list(names)
    return [f"{name} {run.folder.name}" for run, name in zip(runs, seeds, strict=True)]


def _notes(data: Sequence[RunData], truth: str) -> list[str]:
    """Return remarks on runs whose inputs were prepared in another way."""
    names = dict.fromkeys(item.preparation for item in data if item.preparation)
    text = "trained and tested on inputs as prepared in its own data set; motions and times are of"
    return [f"{name}: {text} {truth}." for name in names]


def find_runs(patterns: Sequence[str] | str) -> list[Path]:
    """Return the run folders that match paths or globs.

    Raises:
        ConfigError: if a pattern matches no run folder.
    """
    folders: dict[Path, Path] = {}
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        paths = [Path(path) for path in sorted(glob.glob(str(Path(pattern).expanduser())))]
        matches = [path for path in paths if (path / CONFIG).is_file()]
        if not matches:
            raise ConfigError(f"runs: '{pattern}' matches no run folder (no {CONFIG})")
        folders |= {path.resolve(): path for path in matches}
    if not folders:
        raise ConfigError("runs is empty, expected run folders or globs, as runs=[runs/my_arm/*]")
    return list(folders.values())


def main(cfg: DictConfig) -> float:
    """Evaluate the runs of a configuration and write the results.

    Returns:
        The smallest mean error.

    Raises:
        ConfigError: on settings that do not fit the data. Runs that cannot be loaded are left out
            and named at the end.
    """
    config = checked("evaluate", cfg)
    folder = Path(HydraConfig.get().runtime.output_dir)
    torch.set_num_threads(config["threads"])
    runs, errors = [], []
    for path in find_runs(config["runs"]):
        try:
            runs.append(load_run(path, config["checkpoint"], packages(config.get("trust"))))
        except Exception as error:  # a file that is cut short raises nearly anything
            errors.append(f"{path}: {error}")
            log.warning("left out: %s", errors[-1])
    failure = f"{len(errors)} runs cannot be loaded:\n  " + "\n  ".join(errors)
    if not runs:
        raise ConfigError(failure)
    keys = ("dataset", "split", "horizon", "step", "windows", "thresholds")
    try:
        evaluation = evaluate(runs, **{key: config.get(key) for key in keys})
    except ValueError as error:
        raise ConfigError(str(error)) from error
    trajectory, count = config["trajectory"], len(evaluation.truth.q)
    if not 0 <= trajectory < count:
        raise ConfigError(f"trajectory is {trajectory}, expected 0 to {count - 1}")
    names = evaluation.summary["run"]
    by_name = dict(zip(names, runs, strict=False))
    beside = {"dataset": runs[0].config["dataset"]}
    evaluation.origin = write_provenance(by_name, evaluation.source, config, beside, folder)
    evaluation.save(folder, trajectory)
    print(f"\n{evaluation}\n\nfigures and tables are in {folder}; open report.html in a browser")
    if errors:
        raise ConfigError(failure)
    trained = evaluation.summary[~evaluation.summary["baseline"]]
    return float(trained["error_mean"].min(skipna=True)) if len(trained) else math.inf
