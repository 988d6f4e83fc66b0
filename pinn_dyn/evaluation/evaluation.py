"""Evaluation of models on trajectories that no training saw: tables, figures and a page."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from tqdm import tqdm

from pinn_dyn.data import DataSource, Splits
from pinn_dyn.data.whole import write_whole
from pinn_dyn.ensembles import Ensemble
from pinn_dyn.evaluation.calibration import (
    Calibration,
    calibration,
    calibration_figure,
    calibration_table,
    interval_lines,
)
from pinn_dyn.evaluation.figures import (
    ERROR,
    error_figure,
    terms_figure,
    trajectory_figure,
)
from pinn_dyn.evaluation.learned_terms import TermComparison, compare_with_source
from pinn_dyn.evaluation.metrics import (
    left_data,
    member_metrics,
    rollout_metrics,
    state_squared_error,
)
from pinn_dyn.evaluation.plots import save, with_unit
from pinn_dyn.evaluation.prediction import Prediction, predict_trajectories, predict_windows
from pinn_dyn.evaluation.tables import (
    SEEDS_COLUMNS,
    best_baseline,
    over_seeds,
    summary_columns,
    to_text,
    unbeaten_baselines,
    write_table,
)
from pinn_dyn.evaluation.torque import part_shares, residual_share, torque_error
from pinn_dyn.mechanics import (
    MechanicalSystem,
    Predictor,
    Sum,
    Trajectory,
    samples_of,
    stack_until,
)

log = logging.getLogger(__name__)

SPLITS = {"test": "unseen test trajectories", "validation": "validation trajectories"}
"""Names of the splits of the data in tables and figures."""
_PRINTED = 8  # coordinates: larger matrices do not fit a terminal


@dataclass(frozen=True)
class Entry:
    """A row of the evaluation before its rollouts.

    Attributes:
        run: name of the row.
        model: the predictor.
        truth: test trajectories stacked.
        training: the data that the model was trained on.
        step: step of the rollouts, s.
        name: name of the model and of its settings; rows of one name differ in the seed.
        seed: seed of the run; None for a baseline.
        figures: other columns of the row, such as training pairs and training seconds.
        members: ensemble that gives prediction intervals, or None.
    """

    run: str
    model: Predictor
    truth: Trajectory
    training: Splits
    step: float
    name: str
    seed: int | None = None
    figures: Mapping[str, Any] = field(default_factory=dict)
    members: Ensemble | None = None


@dataclass
class Evaluation:
    """Results of an evaluation.

    Attributes:
        source: the data set.
        split: ``test`` or ``validation``.
        truth: the K trajectories stacked, q ``(K, T, N)``.
        summary: one row per run and baseline, with all metrics.
        by_model: mean and standard deviation over seeds, one row per model and settings.
        torque: torque errors, one row per run and joint; empty without mechanical models.
        parts: contributions of the parts of sums, one row per run, part and term.
        predictions: rollouts by name of the row, baselines included.
        intervals: calibration by run and window in s; runs without members have none.
        terms: learned terms beside the true ones, by run; empty where the truth is unknown.
        constants: tables of fitted constants, by run.
        origin: command, commit, data and configurations, for the page.
    """

    source: DataSource
    split: str
    truth: Trajectory
    summary: pd.DataFrame
    by_model: pd.DataFrame
    torque: pd.DataFrame
    parts: pd.DataFrame
    predictions: dict[str, Prediction]
    intervals: dict[str, dict[float, Calibration]]
    terms: dict[str, TermComparison]
    constants: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    origin: Any = None

    @property
    def models(self) -> dict[str, Prediction]:
        """Rollouts of the trained models."""
        names = self.summary["run"][~self.summary["baseline"]]
        return {name: self.predictions[name] for name in names}

    @property
    def baselines(self) -> dict[str, Prediction]:
        """Rollouts of the baselines."""
        return {k: item for k, item in self.predictions.items() if k not in self.models}

    @property
    def best_baseline(self) -> dict[str, Prediction]:
        """Rollouts of the most accurate baseline, under its name."""
        name = best_baseline(self.summary)
        return {} if name is None else {name: self.predictions[name]}

    @property
    def trajectories(self) -> str:
        """Number and kind of the trajectories, for titles."""
        horizon = f"{self.truth.duration:g} s open loop"
        return f"{len(self.truth.q)} {SPLITS[self.split]}, {horizon}"

    def remarks(self) -> list[str]:
        """Return sentences for below the summary."""
        rows = self.summary[~self.summary["baseline"] & (self.summary["left_data"] > 0)]
        leaving = [
            f"{row.run}: {row.left_data} rollouts leave the training data, the first after "
            f"{row.left_data_after:.3g} s."
            for row in rows.itertuples()
        ]
        intervals = interval_lines(self.intervals)
        return [*unbeaten_baselines(self.summary), *leaving, *intervals]

    def __str__(self) -> str:
        terms = [f"{k}: learned and true terms\n{x.to_text()}" for k, x in self.terms.items()]
        lines = terms if len(self.source.labels) <= _PRINTED else []
        lines.append(f"{self.source.name}: {self.trajectories}")
        lines.append(to_text(self.summary, summary_columns(self.summary)))
        lines.append("* best in its column, and better than all baselines (in brackets)")
        lines += self.remarks()
        if len(self.by_model) < len(self.summary):
            lines += ["", "over seeds:", to_text(self.by_model, SEEDS_COLUMNS)]
        return "\n".join(lines)

    def figures(self, trajectory: int = 0) -> Iterator[tuple[str, Figure]]:
        """Yield the names of all figures, and the figures.

        Args:
            trajectory: index of the trajectory to draw.
        """
        title = f"{self.source.name}, {self.trajectories}"
        yield (
            "trajectory",
            trajectory_figure(
                self.truth,
                self.models,
                trajectory=trajectory,
                title=f"{self.source.name}, {self.split} trajectory {trajectory}, open loop",
                labels=self.source.labels,
                input_labels=self.source.input_labels,
                baselines=self.best_baseline,
            ),
        )
        yield "error", self.error_figure(title)
        if self.intervals:
            yield "calibration", calibration_figure(self.intervals, title=title)
        for run, comparison in self.terms.items():
            for k, name in enumerate(comparison.names):
                text = f"{run}: learned and true terms, {name}"
                figure = terms_figure(comparison, configuration=k, title=text)
                yield f"terms_{_stem(run)}_{name}", figure

    def error_figure(self, title: str) -> Figure:
        """Return the figure of the error over time."""
        label = with_unit(ERROR, self.source.labels)
        return error_figure(self.models, baselines=self.baselines, title=title, label=label)

    def save(self, folder: str | Path, trajectory: int = 0) -> None:
        """Write the tables as CSV, the figures as PNG, and the page ``report.html``.

        Args:
            folder: folder of the results; it is created.
            trajectory: index of the trajectory to draw.
        """
        from pinn_dyn.evaluation.report.prediction_page import prediction_report

        folder = Path(folder)
        tables = {
            "summary": self.summary,
            "by_model": self.by_model,
            "torque": self.torque,
            "parts": self.parts,
            "calibration": calibration_table(self.intervals),
        }
        tables |= {f"terms_{_stem(run)}": x.to_frame() for run, x in self.terms.items()}
        for stem, table in tables.items():
            if len(table):
                write_table(table, folder, stem)
        if self.terms:
            text = "\n\n".join(f"{k}\n{x.to_text()}" for k, x in self.terms.items())
            write_whole(folder / "terms.txt", text + "\n")
        figures = dict(self.figures(trajectory))
        for name, figure in figures.items():
            save(figure, folder / f"{name}.png")
        write_whole(folder / "report.html", prediction_report(self, figures, trajectory))


def _stem(run: str) -> str:
    """Return a part of a file name."""
    return "".join(c if c.isalnum() or c in "-.=" else "_" for c in run)


def evaluate_models(
    entries: Sequence[Entry],
    baselines: Sequence[Entry],
    source: DataSource,
    *,
    split: str,
    stride: int,
    windows: Sequence[float],
    thresholds: Mapping[str, float],
) -> Evaluation:
    """Roll out models and baselines along the test trajectories and compare them with the truth.

    Args:
        entries: trained models.
        baselines: predictors that the models have to beat.
        source: the data set of the test trajectories.
        split: ``test`` or ``validation``.
        stride: samples between two times of comparison, the same for all rows.
        windows: times between two resets to the measured state, s, one windowed error each.
        thresholds: names and values of the valid prediction times, in the units of q.
    """
    rows: list[dict[str, Any]] = []
    torque: list[pd.DataFrame] = []
    parts: list[pd.DataFrame] = []
    predictions: dict[str, Prediction] = {}
    intervals: dict[str, dict[float, Calibration]] = {}
    for index, entry in enumerate(tqdm([*entries, *baselines], desc="evaluating", disable=None)):
        row = {
            "run": entry.run,
            "model": entry.name,
            "seed": entry.seed,
            "baseline": index >= len(entries),
            **entry.figures,
            "step": entry.step,
        }
        prediction = _predict(entry, entry.truth, stride)
        predictions[entry.run] = prediction
        metrics = rollout_metrics(
            prediction.q_hat, prediction.q, prediction.t, thresholds=thresholds
        )
        row |= metrics.to_dict() | state_squared_error(prediction)
        row |= left_data(prediction, entry.training.train)
        if prediction.members is not None:
            row |= member_metrics(prediction)
        for window in windows:
            figures, item = _windowed(entry, window, stride, calibrated=split == "test")
            row |= figures
            if item is not None:
                intervals.setdefault(entry.run, {})[window] = item
        if isinstance(entry.model, MechanicalSystem):
            row |= _force_figures(entry, source, torque, parts)
        rows.append(row)
    summary = pd.DataFrame(rows).astype({"seed": "Int64"})
    terms = {entry.run: compare_with_source(entry.model, source) for entry in entries}
    return Evaluation(
        source=source,
        split=split,
        truth=entries[0].truth,
        summary=summary,
        by_model=over_seeds(summary, ["model", "baseline"]),
        torque=pd.concat(torque, ignore_index=True) if torque else pd.DataFrame(),
        parts=pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(),
        predictions=predictions,
        intervals=intervals,
        terms={run: item for run, item in terms.items() if item is not None},
    )


def _predict(
    entry: Entry, truth: Trajectory, stride: int, window: float | None = None
) -> Prediction:
    """Roll out a model and its members, and return every ``stride``-th sample."""

    def rollout(model: Predictor) -> Prediction:
        if window is None:
            prediction = predict_trajectories(model, truth, step=entry.step)
        else:
            prediction = predict_windows(model, truth, window=window, step=entry.step)
        return prediction.every(stride // samples_of("step", entry.step, truth.t))

    prediction = rollout(entry.model)
    if entry.members is None or entry.members is entry.model:
        return prediction
    return replace(prediction, members=rollout(entry.members).members)


def _windowed(
    entry: Entry, window: float, stride: int, calibrated: bool
) -> tuple[dict[str, float], Calibration | None]:
    """Return the columns of one windowed error, and the calibration of its intervals."""
    prediction = _predict(entry, entry.truth, stride, window)
    metrics = rollout_metrics(prediction.q_hat, prediction.q, prediction.t, thresholds={})
    name = f"window_{window:g}s"
    figures: dict[str, float] = {
        f"{name}_error_mean": metrics.error_mean,
        f"{name}_diverged": metrics.diverged,
    }
    if entry.members is None:
        return figures, None
    # The validation motions selected the checkpoint, but no weights were fitted to them.
    validation = None
    motions = stack_until(entry.training.validation)
    if calibrated and motions.duration >= window:
        validation = _predict(entry, motions, stride, window)
    item = calibration(prediction, validation)
    figures[f"{name}_within"] = item.within
    if item.within_corrected is not None and item.factor is not None:
        figures |= {f"{name}_within_corrected": item.within_corrected}
        figures |= {f"{name}_factor": item.factor}
    return figures, item


def _force_figures(
    entry: Entry, source: DataSource, torque: list[pd.DataFrame], parts: list[pd.DataFrame]
) -> dict[str, float]:
    """Return the columns about forces, and append the tables per joint and per part."""
    model, figures = entry.model, {}
    assert isinstance(model, MechanicalSystem)
    try:
        error = torque_error(model, entry.truth, system=source.system)
        figures = {"torque_error": error.mean, "torque_share": error.share}
        torque.append(error.to_frame(source.labels).assign(run=entry.run))
    except ValueError as message:
        log.warning("no torque error: %s", message)
    if model.has_residual:
        figures["residual_share"] = residual_share(model, entry.truth)
    if isinstance(model, Sum):
        parts.append(part_shares(model, entry.truth).assign(run=entry.run))
    return figures
