"""Evaluation of models on trajectories that no training saw."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from pinn_dyn.data import DataSource, Splits
from pinn_dyn.evaluation.calibration import Calibration, calibration
from pinn_dyn.evaluation.learned_terms import compare_with_source
from pinn_dyn.evaluation.metrics import (
    left_data,
    member_metrics,
    rollout_metrics,
    state_squared_error,
)
from pinn_dyn.evaluation.prediction import Prediction, predict_with_members
from pinn_dyn.evaluation.results import Evaluation
from pinn_dyn.evaluation.tables import (
    over_seeds,
)
from pinn_dyn.evaluation.torque import part_shares, residual_share, torque_error
from pinn_dyn.mechanics import MechanicalSystem, Predictor, Sum, Trajectory, samples_of, stack_until
from pinn_dyn.models import CoupledOscillators
from pinn_dyn.progress import Progress

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Entry:
    """A row of the evaluation before its rollouts.

    Attributes:
        run: name of the row.
        model: the predictor.
        training: the data that the model was trained on.
        step: step of the rollouts, s.
        name: name of the model and of its settings; rows of one name differ in the seed.
        seed: seed of the run; None for a baseline.
        figures: other columns of the row, such as training pairs and training seconds.
        members: ensemble that gives prediction intervals, or None.
    """

    run: str
    model: Predictor
    training: Splits
    step: float
    name: str
    seed: int | None = None
    figures: Mapping[str, Any] = field(default_factory=dict)
    members: Predictor | None = None


def evaluate_models(
    entries: Sequence[Entry],
    baselines: Sequence[Entry],
    source: DataSource,
    truth: Trajectory,
    *,
    split: str,
    stride: int,
    windows: Sequence[float],
    thresholds: Mapping[str, float],
    progress: Progress,
) -> Evaluation:
    """Roll out models and baselines along the test trajectories and compare them with the truth.

    Args:
        entries, baselines: trained models, and predictors that they have to beat.
        source: the data set of the test trajectories.
        truth: the test trajectories stacked, q ``(K, T, N)``.
        split: ``test`` or ``validation``.
        stride: samples between two times of comparison, the same for all rows.
        windows: times between two resets to the measured state, s, one windowed error each.
        thresholds: names and values of the valid prediction times, in the units of q.
        progress: counter of the evaluated models.
    """
    rows: list[dict[str, Any]] = []
    torque, parts, ensembles = [pd.DataFrame()], [pd.DataFrame()], []
    predictions: dict[str, Prediction] = {}
    intervals: dict[str, dict[float, Calibration]] = {}
    progress.total = len(entries) + len(baselines)
    share_data = all(entry.training is entries[0].training for entry in entries)
    validates = split == "test" and len(entries) > 1 and share_data
    for index, entry in enumerate([*entries, *baselines]):
        model, run = entry.model, entry.run
        progress.update(index, f", now {run}")
        row: dict[str, Any] = {"run": run, "model": entry.name, "seed": entry.seed}
        row |= {"baseline": index >= len(entries), **entry.figures, "step": entry.step}
        item = predictions[run] = _predict(entry, truth, stride)
        row |= rollout_metrics(item.q_hat, item.q, item.t, thresholds=thresholds).to_dict()
        row |= state_squared_error(item) | left_data(item, entry.training.train)
        if validates and index < len(entries):
            row["validation_error_mean"] = _validation_error(entry, truth.duration, stride)
        if item.members is not None:
            ensembles.append({"run": run, **member_metrics(item)})
        for window in windows:
            item = _predict(entry, truth, stride, window)
            metrics = rollout_metrics(item.q_hat, item.q, item.t, thresholds={})
            name = f"window_{window:g}s"
            row |= {f"{name}_error_mean": metrics.error_mean, f"{name}_diverged": metrics.diverged}
            if entry.members is not None:
                result = _calibration(entry, item, stride, window if split == "test" else None)
                intervals.setdefault(run, {})[window] = result
                row[f"{name}_within"] = result.within
                if result.corrected is not None:
                    row[f"{name}_within_corrected"] = result.within_corrected
                    row[f"{name}_factor"] = result.factor
        if isinstance(model, MechanicalSystem) and model.num_inputs:
            try:
                error = torque_error(model, truth, system=source.system)
                row |= {"torque_error": error.mean, "torque_share": error.share}
                torque.append(error.to_frame(source.labels).assign(run=run))
            except ValueError as message:
                log.warning("no torque error: %s", message)
        if isinstance(model, MechanicalSystem) and model.has_residual:
            row["residual_share"] = residual_share(model, truth)
        if isinstance(model, Sum):
            parts.append(part_shares(model, truth).assign(run=run))
        rows.append(row)
    summary = pd.DataFrame(rows).astype({"seed": "Int64"})
    terms = {entry.run: compare_with_source(entry.model, source) for entry in entries}
    modes = {x.run: x.model.modes() for x in entries if isinstance(x.model, CoupledOscillators)}
    return Evaluation(
        source=source,
        split=split,
        truth=truth,
        summary=summary,
        by_model=over_seeds(summary, ["model", "baseline"]),
        torque=pd.concat(torque, ignore_index=True),
        ensembles=pd.DataFrame(ensembles),
        parts=pd.concat(parts, ignore_index=True),
        predictions=predictions,
        intervals=intervals,
        terms={run: item for run, item in terms.items() if item is not None},
        modes=modes,
    )


def _predict(
    entry: Entry, truth: Trajectory, stride: int, window: float | None = None
) -> Prediction:
    prediction = predict_with_members(
        entry.model, entry.members, truth, window=window, step=entry.step
    )
    return prediction.every(stride // samples_of("step", entry.step, truth.t))


def _validation_error(entry: Entry, horizon: float, stride: int) -> float:
    """Return the mean error on the validation data, infinite if a rollout diverged."""
    motions = stack_until(entry.training.validation)
    motions = motions.until(min(horizon, motions.duration))
    item = _predict(entry, motions, stride)
    metrics = rollout_metrics(item.q_hat, item.q, item.t, thresholds={})
    return math.inf if metrics.diverged else metrics.error_mean


def _calibration(
    entry: Entry, held_out: Prediction, stride: int, window: float | None
) -> Calibration:
    """Return the calibration of intervals, corrected on the validation data with a window."""
    motions = stack_until(entry.training.validation)
    if window is None or motions.duration < window:
        return calibration(held_out, None)
    return calibration(held_out, _predict(entry, motions, stride, window))
