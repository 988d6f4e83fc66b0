"""Compare trained models on trajectories that no training saw, as evaluate.py does."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from tqdm import tqdm

from pinn_dyn.app.build import build_source
from pinn_dyn.app.config import ConfigError, checked
from pinn_dyn.app.provenance import build_origin, command_line, data_hash, provenance
from pinn_dyn.app.run_folder import Run, find_runs, load_run
from pinn_dyn.app.trust import packages
from pinn_dyn.data import DataSource
from pinn_dyn.evaluation import (
    Prediction,
    RunResult,
    TermComparison,
    compare_terms,
    error_figure,
    format_table,
    grouped_table,
    member_metrics,
    predict_trajectories,
    predict_windows,
    rollout_metrics,
    save,
    spread_figure,
    summary_table,
    terms_figure,
    trajectory_figure,
    write_table,
)
from pinn_dyn.evaluation.report import prediction_report
from pinn_dyn.mechanics import MechanicalSystem, Trajectory, stack

log = logging.getLogger(__name__)

# Columns of the terminal's table; the files hold all of them.
_SHOWN = (
    "error_mean",
    "error_std",
    "error_median",
    "error_worst",
    "diverged",
    "squared_error_mean",
    "member_error_mean",
    "member_error_std",
    "spread_over_error",
)

# What each split of the data is called in tables and figures.
_SPLITS = {"test": "unseen test trajectories", "validation": "validation trajectories"}


@dataclass(frozen=True)
class Evaluation:
    """One run's roll-outs and its row of the table."""

    run: Run
    label: str
    prediction: Prediction
    result: RunResult


def evaluate(cfg: DictConfig) -> float:
    """Evaluate runs side by side; returns the smallest mean error.

    Raises:
        ConfigError: on runs that cannot be loaded, or that were trained on different data.
    """
    config = checked("evaluate", cfg)
    split = config["split"]
    folder = Path(HydraConfig.get().runtime.output_dir)
    torch.set_num_threads(config["threads"])
    trust = packages(config.get("trust"))
    runs = [load_run(path, config["checkpoint"], trust) for path in find_runs(config["runs"])]
    source = build_source(_shared_dataset(runs))
    try:
        truth = stack(getattr(source.load(), split))
    except ValueError as error:
        raise ConfigError(f"{source.name}: {error}") from error
    log.info("%d runs on %d %s of %s", len(runs), truth.q.shape[0], _SPLITS[split], source.name)

    labels = _labels(runs)
    evaluations = []
    for run, label in zip(tqdm(runs, desc="evaluating runs"), labels, strict=True):
        try:
            evaluations.append(_evaluate(run, label, truth, config))
        except ValueError as error:
            raise ConfigError(f"{run.folder}: {error}") from error
    summary = summary_table([item.result for item in evaluations])
    write_table(summary, folder, "summary")
    grouped = grouped_table(summary)
    write_table(grouped, folder, "by_model")
    record = {"command": command_line(), "data_hash": data_hash(source), **provenance()}
    (folder / "provenance.json").write_text(
        json.dumps({"config": config, "dataset": runs[0].config["dataset"], **record}, indent=2)
    )
    horizon_truth = truth.until(config["horizon"])
    _draw(evaluations, horizon_truth, source, config, folder)
    comparisons = _compare_with_truth(evaluations, source, folder)

    horizon = f"{config['horizon']:g} s"
    shown = ["run", "seed", "pairs", *_SHOWN, *[c for c in summary if c.startswith("window_")]]
    text = _terms_text(comparisons)
    print(f"\n{text}" if text else "")
    trajectories = f"{truth.q.shape[0]} {_SPLITS[split]}"
    print(f"{source.name}: {trajectories}, {horizon} open loop")
    print(format_table(summary[[name for name in shown if name in summary]]))
    if len(grouped) < len(summary):
        best = [
            "model",
            "runs",
            *[c for c in grouped if c.endswith(("_error_mean", "_error_worst"))],
        ]
        print(f"\nover seeds:\n{format_table(grouped[[c for c in best if c in grouped]])}")
    report = prediction_report(
        title=f"{source.name}: trained models on unseen motions",
        trajectories=trajectories,
        summary=summary,
        grouped=grouped,
        truth=horizon_truth,
        predictions={item.label: item.prediction for item in evaluations},
        trajectory=config["trajectory"],
        labels=source.labels,
        input_labels=source.input_labels,
        comparisons=comparisons,
        origin=build_origin({item.label: item.run for item in evaluations}, source, record, config),
    )
    (folder / "report.html").write_text(report, encoding="utf-8")
    print(f"\nfigures and tables are in {folder}; open report.html there in a browser")
    return float(summary["error_mean"].min())


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


def _evaluate(run: Run, label: str, truth: Trajectory, config: dict[str, Any]) -> Evaluation:
    step = run.model.fixed_step or config["step"] or run.statistics.step
    horizon = truth.until(config["horizon"])
    prediction = predict_trajectories(run.model, horizon, step=step)
    metrics = rollout_metrics(
        prediction.q_hat, prediction.q, prediction.t, thresholds=config["thresholds"]
    ).to_dict()
    if prediction.members is not None:
        metrics |= member_metrics(prediction)
    for window in config["windows"]:
        windowed = predict_windows(run.model, horizon, window=window, step=step)
        figures = rollout_metrics(windowed.q_hat, windowed.q, windowed.t, thresholds={})
        metrics[f"window_{window:g}s_error_mean"] = figures.error_mean
    recorded = ("pairs", "parameters", "training_seconds", "training_cpu_seconds")
    extra = {name: run.metrics[name] for name in recorded if name in run.metrics}
    result = RunResult(
        label, run.config["model_name"], run.config["seed"], metrics, {**extra, "step": step}
    )
    return Evaluation(run, label, prediction, result)


def _draw(
    evaluations: list[Evaluation],
    truth: Trajectory,
    source: DataSource,
    config: dict[str, Any],
    folder: Path,
) -> None:
    predictions = {item.label: item.prediction for item in evaluations}
    split = config["split"]
    title = f"{source.name}, {_SPLITS[split]}, {config['horizon']:g} s open loop"
    figure = trajectory_figure(
        truth,
        predictions,
        trajectory=config["trajectory"],
        title=f"{source.name}, {split} trajectory {config['trajectory']}, open loop",
        labels=source.labels,
        input_labels=source.input_labels,
    )
    save(figure, folder / "trajectory.png")
    save(error_figure(predictions, title=title), folder / "error.png")
    for label, prediction in predictions.items():
        if prediction.members is not None:
            figure = spread_figure(
                prediction, title=f"{title}\n{label}, {len(prediction.members)} members"
            )
            save(figure, folder / f"spread_{label.replace(' ', '_')}.png")


def _compare_with_truth(
    evaluations: list[Evaluation], source: DataSource, folder: Path
) -> dict[str, TermComparison]:
    """Write learned against true terms of each structured model; returns them by its label."""
    if source.system is None or not source.configurations:
        return {}
    names = list(source.configurations)
    q = torch.tensor([source.configurations[name] for name in names], dtype=torch.float64)
    comparisons = {}
    for item in evaluations:
        model = item.run.model
        if not isinstance(model, MechanicalSystem):
            continue
        comparison = compare_terms(model, source.system, q, names=names)
        comparisons[item.label] = comparison
        stem = item.label.replace(" ", "_")
        write_table(comparison.to_frame(), folder, f"terms_{stem}")
        for index, name in enumerate(names):
            figure = terms_figure(
                comparison,
                configuration=index,
                title=f"{item.label}: learned and true terms, {name}",
                inverse_mass=model.state == "qp",
            )
            save(figure, folder / f"terms_{stem}_{name}.png")
    (folder / "terms.txt").write_text(_terms_text(comparisons) + "\n")
    return comparisons


def _terms_text(comparisons: dict[str, TermComparison]) -> str:
    return "\n\n".join(
        f"{label}: learned and true terms\n{item.to_text()}" for label, item in comparisons.items()
    )
