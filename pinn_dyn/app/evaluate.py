"""Compare trained models on trajectories that no training saw, as evaluate.py does."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tqdm import tqdm

from pinn_dyn.app.config import ConfigError, checked
from pinn_dyn.app.constants import read_constants
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
from pinn_dyn.app.identification import identified
from pinn_dyn.app.jobs import find_runs
from pinn_dyn.app.provenance import write_provenance
from pinn_dyn.app.run_folder import METRICS, Run, load_run
from pinn_dyn.app.shared_data import RunData, shared_data
from pinn_dyn.app.trust import packages
from pinn_dyn.data import DataSource, Splits
from pinn_dyn.data.fastest_motion import too_long_for
from pinn_dyn.data.whole import write_whole
from pinn_dyn.ensembles import Ensemble
from pinn_dyn.evaluation import (
    Prediction,
    RunResult,
    beaten_by_floors,
    best_floor,
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
from pinn_dyn.evaluation.report.prediction_page import shown_columns
from pinn_dyn.mechanics import Predictor, Trajectory, samples_of, stack_until

log = logging.getLogger(__name__)

_PRINTED = 8  # coordinates whose matrices a terminal has room for


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
    try:
        data = shared_data(runs, config)
        plain = next(k for k, one in enumerate(data) if not one.preparation)
        source, motions = data[plain].source, data[plain].trajectories
        shortest = stack_until(motions).duration
        config["horizon"] = config["horizon"] or default_horizon(shortest)
        truths = [stack_until(one.trajectories, config["horizon"]) for one in data]
        truth = truths[plain]
        steps = [run.model.fixed_step or config["step"] or run.statistics.step for run in runs]
        stride = common_stride(steps, truth.t)
    except ValueError as error:
        named = config.get("dataset") or runs[0].config["dataset"]
        raise ConfigError(f"{named.get('name', 'dataset')}: {error}") from error
    if long := too_long_for(motions, max(steps), source.labels):
        log.warning("%s: %s", source.name, long)
    for run, one in zip(runs, data, strict=True):
        check_data(run.folder, one.trained_on)
    grid = stride * truth.duration / (len(truth.t) - 1)
    if config["windows"] is None:
        config["windows"] = default_windows(config["horizon"], grid)
    if not 0 <= config["trajectory"] < len(truth.q):
        raise ConfigError(
            f"trajectory is {config['trajectory']}, expected 0 to {len(truth.q) - 1}, one of the "
            f"{len(truth.q)} {SPLITS[split]}"
        )
    if (dropped := len(motions) - len(truth.q)) > 0:
        log.warning(
            "%d of %d %s of %s are shorter than horizon=%g and left out",
            *(dropped, len(motions), SPLITS[split], source.name, config["horizon"]),
        )
    log.info("%d runs on %d %s of %s", len(runs), truth.q.shape[0], SPLITS[split], source.name)

    names = _model_names(runs, data)
    labels = _labels(runs, names)
    entrants = [
        _Entrant(_row(run, label, name, step), run.model, truth, one.training, run.members())
        for run, label, name, step, truth, one in zip(
            runs, labels, names, steps, truths, data, strict=True
        )
    ]
    notes = _notes(data, source)
    training = data[plain].training
    floors = build_floors(training.train, training.validation, step=grid)
    entrants += [
        _Entrant(_floor(label, grid), floor, truth, training) for label, floor in floors.items()
    ]
    fits = identified(runs, data)
    for k, model in fits.items():
        label = "identification"
        if len(fits) > 1 or label in labels:
            label = f"identification of {labels[k]}"
        entrants.append(_Entrant(_floor(label, steps[k]), model, truths[k], data[k].training))
        notes.append(
            f"{label}: the constants of {labels[k]} by its inverse dynamics alone, as "
            "optimizer.rollouts=false trains them"
        )
    evaluations = []
    for entrant in tqdm(entrants, desc="evaluating", disable=None):
        try:
            evaluations.append(_evaluate(entrant, stride, config))
        except ValueError as error:
            raise ConfigError(f"run '{entrant.row.run}': {error}") from error
    trained = evaluations[: len(runs)]
    joints = torque_errors(evaluations, source)
    parts = shares(evaluations)
    summary = summary_table([item.result for item in evaluations])
    write_table(summary, folder, "summary")
    grouped = grouped_table(summary)
    write_table(grouped, folder, "by_model")
    if len(joints):
        write_table(joints, folder, "torque")
    if len(parts):
        write_table(parts, folder, "parts")
    by_label = dict(zip(labels, runs, strict=True))
    beside = {"dataset": runs[plain].config["dataset"]}
    origin = write_provenance(by_label, source, config, beside, folder)
    draw(evaluations, best_floor(summary), truth, source, config, folder)
    intervals = write_intervals(trained, source, split, folder)
    comparisons = compare_with_truth(trained, source, folder)

    columns = {"floor", "error_std", *shown_columns(summary)} - {"training_seconds"}
    shown = [name for name in summary if name in columns or name.endswith("s_diverged")]
    text = terms_text(comparisons)
    if comparisons and len(source.labels) > _PRINTED:
        text = f"learned and true terms are in {folder / 'terms.txt'}"
    print(f"\n{text}" if text else "")
    trajectories = f"{truth.q.shape[0]} {SPLITS[split]}"
    print(f"{source.name}: {trajectories}, {config['horizon']:g} s open loop")
    headers = {name: name.removesuffix("_error_mean") for name in summary if "window_" in name}
    headers |= {"left_data_after": "after", "torque_share": "torque", "residual_share": "residual"}
    headers |= {"input_delay_seconds": "delay"}
    print(format_table(summary[shown], headers))
    verdict = beaten_by_floors(summary)
    star = "* best; only a model that beats all in brackets; valid_time, after and delay in s"
    print("\n".join([star, *notes, *verdict, *interval_lines(intervals)]))
    if len(grouped) < len(summary):
        figures = [c for c in grouped if c.endswith(("_error_mean", "_error_worst"))]
        print(f"\nover seeds:\n{format_table(grouped[['model', 'seeds', 'floor', *figures]])}")
    report = prediction_report(
        title=f"{source.name}: trained models on unseen motions",
        trajectories=trajectories,
        summary=summary,
        grouped=grouped,
        notes=notes,
        truth=truth,
        predictions={item.result.run: item.prediction for item in evaluations},
        trajectory=config["trajectory"],
        labels=source.labels,
        input_labels=source.input_labels,
        comparisons=comparisons,
        joints=joints,
        constants=read_constants({label: run.folder for label, run in by_label.items()}),
        parts=parts,
        intervals=intervals,
        origin=origin,
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


def _model_names(runs: list[Run], data: list[RunData]) -> list[str]:
    """The model of each run, and how its inputs were prepared where that is not as in the truth."""
    return [
        f"{run.config['model_name']} {one.preparation}".rstrip()
        for run, one in zip(runs, data, strict=True)
    ]


def _labels(runs: list[Run], models: list[str]) -> list[str]:
    """Short names of runs: the model, with its seed and folder only where they tell apart."""
    seeds = [f"{m} seed {run.config['seed']}" for m, run in zip(models, runs, strict=True)]
    for names in (models, seeds):
        if len(set(names)) == len(names):
            return names
    return [f"{name} {run.folder.name}" for name, run in zip(seeds, runs, strict=True)]


def _row(run: Run, label: str, model: str, step: float) -> RunResult:
    """The row of a trained model, without its figures."""
    recorded = ("pairs", "parameters", "training_seconds", "training_cpu_seconds")
    extra = {name: run.metrics[name] for name in recorded if name in run.metrics}
    extra |= {"step": step, **run.model.learned_figures()}
    return RunResult(label, model, run.config["seed"], {}, extra)


def _floor(label: str, step: float) -> RunResult:
    """The row of what a model has to beat, without its figures."""
    return RunResult(label, label, None, {}, {"step": step}, floor=True)


def _notes(data: list[RunData], source: DataSource) -> list[str]:
    """What to know of the rows whose inputs were prepared otherwise."""
    names = [name for name in dict.fromkeys(one.preparation for one in data) if name]
    if not names:
        return []
    listed = "; ".join(names)
    return [
        f"{listed}: trained and predicting on inputs as their own data sets prepare them. Motions, "
        f"starts and times are those of the rows without such a word ({source.name})"
    ]


@dataclass(frozen=True)
class _Entrant:
    """A row of the table before its roll-outs: what predicts, and on which motions."""

    row: RunResult
    model: Predictor
    truth: Trajectory
    training: Splits
    members: Ensemble | None = None


def _evaluate(entrant: _Entrant, stride: int, config: dict[str, Any]) -> Evaluation:
    """Roll out over the horizon and window by window; compared at every ``stride``-th sample."""
    row, model, truth = entrant.row, entrant.model, entrant.truth
    training, members = entrant.training, entrant.members
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
    return Evaluation(model, truth, prediction, replace(row, metrics=metrics), intervals)
