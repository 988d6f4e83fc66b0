"""Compare trained models on trajectories that no training saw, as evaluate.py does."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tqdm import tqdm

from pinn_dyn.app.build import build_source
from pinn_dyn.app.config import ConfigError, checked
from pinn_dyn.app.data_record import check_data
from pinn_dyn.app.evaluation_results import (
    SPLITS,
    Evaluation,
    compare_with_truth,
    draw,
    shares,
    terms_text,
    torque_errors,
    write_intervals,
)
from pinn_dyn.app.provenance import build_origin, command_line, data_hash, provenance
from pinn_dyn.app.run_folder import CONFIG, METRICS, Run, find_runs, load_run, write_json
from pinn_dyn.app.trust import packages
from pinn_dyn.data import Splits
from pinn_dyn.data.fastest_motion import too_long_for
from pinn_dyn.data.whole import write_whole
from pinn_dyn.ensembles import Ensemble
from pinn_dyn.evaluation import (
    Prediction,
    RunResult,
    beaten_by_floors,
    build_floors,
    calibration,
    common_stride,
    default_horizon,
    default_windows,
    format_table,
    grouped_table,
    interval_lines,
    left_data,
    member_metrics,
    predict_trajectories,
    predict_windows,
    rollout_metrics,
    state_squared_error,
    summary_table,
    write_table,
)
from pinn_dyn.evaluation.report import prediction_report
from pinn_dyn.mechanics import Predictor, Trajectory, samples_of, stack_until

log = logging.getLogger(__name__)

_PRINTED = 8  # coordinates whose matrices a terminal has room for
# Columns of the terminal's table; the files hold all of them.
_SHOWN = (
    "error_mean",
    "error_std",
    "error_median",
    "error_worst",
    "diverged",
    "left_data",
    "left_data_after",
    "torque_share",
    "residual_share",
    "member_error_mean",
    "member_error_std",
    "spread_over_error",
    "input_delay_seconds",
)


def evaluate(cfg: DictConfig) -> float:
    """Evaluate runs side by side, and floors beside them; returns the smallest mean error.

    Raises:
        ConfigError: on settings that do not fit the data, and on runs that were trained on
            different data, on data that have changed since, or on other coordinates or inputs than
            those of ``dataset``. Run folders that cannot be loaded are passed over; when all else
            is written, they end the program with this error too.
    """
    config = checked("evaluate", cfg)
    split = config["split"]
    folder = Path(HydraConfig.get().runtime.output_dir)
    torch.set_num_threads(config["threads"])
    trust = packages(config.get("trust"))
    runs, damaged = _load_all(find_runs(config["runs"]), config["checkpoint"], trust)
    trained_on = build_source(_shared_dataset(runs))
    source = build_source(config) if config.get("dataset") else trained_on
    sizes = [len(source.labels), len(source.input_labels)]
    if sizes != [len(trained_on.labels), len(trained_on.input_labels)]:
        raise ConfigError(
            f"dataset: {source.name} has {sizes[0]} coordinates and {sizes[1]} inputs, the runs "
            f"were trained on {len(trained_on.labels)} and {len(trained_on.input_labels)}"
        )
    try:
        training = trained_on.load()
        trajectories = getattr(source.load(), split)
        truth = stack_until(trajectories)
        config["horizon"] = config["horizon"] or default_horizon(truth.duration)
        truth = stack_until(trajectories, config["horizon"])
        steps = [run.model.fixed_step or config["step"] or run.statistics.step for run in runs]
        stride = common_stride(steps, truth.t)
    except ValueError as error:
        raise ConfigError(f"{source.name}: {error}") from error
    if long := too_long_for(trajectories, max(steps), source.labels):
        log.warning("%s: %s", source.name, long)
    for run in runs:
        check_data(run.folder, trained_on)
    grid = stride * truth.duration / (len(truth.t) - 1)
    if config["windows"] is None:
        config["windows"] = default_windows(config["horizon"], grid)
    if not 0 <= config["trajectory"] < len(truth.q):
        raise ConfigError(
            f"trajectory is {config['trajectory']}, expected 0 to {len(truth.q) - 1}, one of the "
            f"{len(truth.q)} {SPLITS[split]}"
        )
    if (dropped := len(trajectories) - len(truth.q)) > 0:
        log.warning(
            "%d of %d %s of %s are shorter than horizon=%g and left out",
            *(dropped, len(trajectories), SPLITS[split], source.name, config["horizon"]),
        )
    log.info("%d runs on %d %s of %s", len(runs), truth.q.shape[0], SPLITS[split], source.name)

    labels = _labels(runs)
    rows = [_row(run, label, step) for run, label, step in zip(runs, labels, steps, strict=True)]
    models = [run.model for run in runs]
    members = [run.members() for run in runs]
    for label, floor in build_floors(training.train, training.validation, step=grid).items():
        rows.append(RunResult(label, label, None, {}, {"step": grid}, floor=True))
        models.append(floor)
        members.append(None)
    evaluations = []
    progress = tqdm(models, desc="evaluating", disable=None)
    for model, drawn, row in zip(progress, members, rows, strict=True):
        try:
            evaluations.append(_evaluate(model, drawn, row, truth, training, stride, config))
        except ValueError as error:
            raise ConfigError(f"run '{row.run}': {error}") from error
    trained = evaluations[: len(runs)]
    joints = torque_errors(trained, truth, source)
    parts = shares(trained, truth)
    summary = summary_table([item.result for item in evaluations])
    write_table(summary, folder, "summary")
    grouped = grouped_table(summary)
    write_table(grouped, folder, "by_model")
    if len(joints):
        write_table(joints, folder, "torque")
    if len(parts):
        write_table(parts, folder, "parts")
    record = {"command": command_line(), "data_hash": data_hash(source), **provenance()}
    made = {"config": config, "dataset": runs[0].config["dataset"], **record}
    write_json(folder / "provenance.json", made)
    draw(evaluations, truth, source, config, folder)
    intervals = write_intervals(trained, source, split, folder)
    comparisons = compare_with_truth(trained, source, folder)

    shown = ["run", "seed", "floor", "pairs", *_SHOWN]
    shown += [name for name in summary if name.startswith("valid_time_")]
    shown += [name for name in summary if name.endswith(("s_error_mean", "s_diverged"))]
    text = terms_text(comparisons)
    if comparisons and len(source.labels) > _PRINTED:
        text = f"learned and true terms are in {folder / 'terms.txt'}"
    print(f"\n{text}" if text else "")
    trajectories = f"{truth.q.shape[0]} {SPLITS[split]}"
    print(f"{source.name}: {trajectories}, {config['horizon']:g} s open loop")
    headers = {name: name.removesuffix("_error_mean") for name in summary if "window_" in name}
    headers |= {"left_data_after": "after", "torque_share": "torque", "residual_share": "residual"}
    headers |= {"input_delay_seconds": "delay"}
    print(format_table(summary[[name for name in shown if name in summary]], headers))
    verdict = beaten_by_floors(summary)
    notes = ["* best; only a model that beats all in brackets; valid_time, after and delay in s"]
    print("\n".join([*notes, *verdict, *interval_lines(intervals)]))
    if len(grouped) < len(summary):
        figures = [c for c in grouped if c.endswith(("_error_mean", "_error_worst"))]
        print(f"\nover seeds:\n{format_table(grouped[['model', 'seeds', 'floor', *figures]])}")
    report = prediction_report(
        title=f"{source.name}: trained models on unseen motions",
        trajectories=trajectories,
        summary=summary,
        grouped=grouped,
        truth=truth,
        predictions={item.result.run: item.prediction for item in evaluations},
        trajectory=config["trajectory"],
        labels=source.labels,
        input_labels=source.input_labels,
        comparisons=comparisons,
        joints=joints,
        parts=parts,
        intervals=intervals,
        origin=build_origin(dict(zip(labels, runs, strict=True)), source, record, config),
    )
    write_whole(folder / "report.html", report)
    print(f"\nfigures and tables are in {folder}; open report.html there in a browser")
    if damaged:
        raise ConfigError(
            f"{len(damaged)} of {len(damaged) + len(runs)} runs could not be evaluated and are "
            "missing from the tables:\n  " + "\n  ".join(damaged)
        )
    return float(summary["error_mean"][~summary["floor"]].min())


def _load_all(
    folders: list[Path], checkpoint: str, trust: tuple[str, ...]
) -> tuple[list[Run], list[str]]:
    """The runs that can be loaded, and what is wrong with each of the others.

    Raises:
        ConfigError: if none can.
    """
    runs, damaged = [], []
    for folder in folders:
        try:
            run = load_run(folder, checkpoint, trust)
            if missing := [
                key for key in ("dataset", "model_name", "seed") if key not in run.config
            ]:
                raise ConfigError(f"its {CONFIG} has no {', '.join(missing)}, it may be cut short")
            runs.append(run)
            if not (folder / METRICS).is_file():
                log.warning(
                    "%s has no %s: its training goes on, or was interrupted, and the errors are "
                    "those of what it has learned so far",
                    *(folder, METRICS),
                )
        except Exception as error:  # a file that is cut short raises nearly anything
            said = f"{type(error).__name__} {error}"
            text = str(error) if isinstance(error, ConfigError) else f"it may be cut short: {said}"
            damaged.append(f"{folder}: {text}")
            log.warning("passed over: %s", damaged[-1])
    if not runs:
        raise ConfigError("runs: none can be loaded:\n  " + "\n  ".join(damaged))
    return runs, damaged


def _shared_dataset(runs: list[Run]) -> dict[str, Any]:
    """The part of the configuration that says which data all runs were trained on."""
    first = runs[0]
    for run in runs[1:]:
        if _without_cache(run.config) != _without_cache(first.config):
            raise ConfigError(
                f"runs: {run.folder} was trained on another data set than {first.folder} "
                "(compare 'dataset' in their config.yaml): evaluate them separately"
            )
    return first.config


def _without_cache(config: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in config["dataset"].items() if key != "cache"}


def _labels(runs: list[Run]) -> list[str]:
    """Short names of runs: the model, with its seed and folder only where they tell apart."""
    models = [run.config["model_name"] for run in runs]
    seeds = [f"{m} seed {run.config['seed']}" for m, run in zip(models, runs, strict=True)]
    for names in (models, seeds):
        if len(set(names)) == len(names):
            return names
    return [f"{name} {run.folder.name}" for name, run in zip(seeds, runs, strict=True)]


def _row(run: Run, label: str, step: float) -> RunResult:
    """The row of a trained model, without its figures."""
    recorded = ("pairs", "parameters", "training_seconds", "training_cpu_seconds")
    extra = {name: run.metrics[name] for name in recorded if name in run.metrics}
    extra |= {"step": step, **run.model.learned_figures()}
    return RunResult(label, run.config["model_name"], run.config["seed"], {}, extra)


def _evaluate(
    model: Predictor,
    members: Ensemble | None,
    row: RunResult,
    truth: Trajectory,
    training: Splits,
    stride: int,
    config: dict[str, Any],
) -> Evaluation:
    """Roll out over the horizon and window by window; compared at every ``stride``-th sample."""
    step = row.extra["step"]
    every = stride // samples_of("step", step, truth.t)

    def predicted(roll_out: Callable[..., Prediction], **given: Any) -> Prediction:
        found = roll_out(model, step=step, **given).every(every)
        if members in (None, model):
            return found
        return replace(found, members=roll_out(members, step=step, **given).every(every).members)

    prediction = predicted(predict_trajectories, truth=truth)
    metrics = rollout_metrics(
        prediction.q_hat, prediction.q, prediction.t, thresholds=config["thresholds"]
    ).to_dict()
    metrics |= state_squared_error(prediction) | left_data(prediction, training.train)
    if prediction.members is not None:
        metrics |= member_metrics(prediction)
    # The model was chosen by these motions, but not fitted to them.
    seen = stack_until(training.validation) if config["split"] == "test" else None
    intervals = {}
    for window in config["windows"]:
        windowed = predicted(predict_windows, truth=truth, window=window)
        figures = rollout_metrics(windowed.q_hat, windowed.q, windowed.t, thresholds={})
        metrics[f"window_{window:g}s_error_mean"] = figures.error_mean
        metrics[f"window_{window:g}s_diverged"] = figures.diverged
        if members is not None:
            fits = seen is not None and seen.duration >= window
            known = predicted(predict_windows, truth=seen, window=window) if fits else None
            found = intervals[window] = calibration(windowed, known)
            metrics[f"window_{window:g}s_within"] = found.within
            if found.within_corrected is not None and found.factor is not None:
                metrics[f"window_{window:g}s_within_corrected"] = found.within_corrected
                metrics[f"window_{window:g}s_factor"] = found.factor
    return Evaluation(model, prediction, replace(row, metrics=metrics), intervals)
