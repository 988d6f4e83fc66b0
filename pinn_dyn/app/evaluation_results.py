"""What evaluate.py writes beside its table: torque errors, shares, figures, terms, intervals."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from pinn_dyn.data import DataSource
from pinn_dyn.data.whole import write_whole
from pinn_dyn.evaluation import (
    Calibration,
    Prediction,
    RunResult,
    TermComparison,
    calibration_figure,
    calibration_table,
    compare_terms,
    error_figure,
    part_shares,
    residual_share,
    save,
    spread_figure,
    terms_figure,
    torque_error,
    trajectory_figure,
    write_table,
)
from pinn_dyn.evaluation.drawing import with_unit
from pinn_dyn.evaluation.figures import ERROR
from pinn_dyn.mechanics import MechanicalSystem, Predictor, Sum, Trajectory

log = logging.getLogger(__name__)

SPLITS = {"test": "unseen test trajectories", "validation": "validation trajectories"}
"""What each split of the data is called in tables and figures."""


@dataclass(frozen=True)
class Evaluation:
    """The roll-outs of one run, or of a floor, and the row of the table.

    ``truth`` has the inputs as the run knows them; ``intervals`` are those of its windowed
    predictions, by window in s; none of a single network.
    """

    model: Predictor
    truth: Trajectory
    prediction: Prediction
    result: RunResult
    intervals: dict[float, Calibration]


def torque_errors(evaluations: list[Evaluation], source: DataSource) -> pd.DataFrame:
    """Give mechanical models their torque error; returns it joint by joint."""
    tables = []
    for item in evaluations:
        if isinstance(item.model, MechanicalSystem):
            try:
                found = torque_error(item.model, item.truth, system=source.system)
            except ValueError as error:
                log.warning("no torque error: %s", error)
                break
            item.result.metrics.update(torque_error=found.mean, torque_share=found.share)
            tables.append(found.to_frame(source.labels).assign(run=item.result.run))
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def shares(evaluations: list[Evaluation]) -> pd.DataFrame:
    """Give models with a residual force its share; returns what the parts of sums contribute."""
    tables = []
    for item in evaluations:
        if isinstance(item.model, MechanicalSystem) and item.model.has_residual:
            item.result.metrics["residual_share"] = residual_share(item.model, item.truth)
        if isinstance(item.model, Sum):
            tables.append(part_shares(item.model, item.truth).assign(run=item.result.run))
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def draw(
    evaluations: list[Evaluation],
    lowest: str | None,
    truth: Trajectory,
    source: DataSource,
    config: dict[str, Any],
    folder: Path,
) -> None:
    """Write the figures of one trajectory, of errors over time, and of the spread of members.

    Of all floors the figure of a trajectory has the ``lowest``, and that of the errors each.
    """
    floors, predictions = (
        {x.result.run: x.prediction for x in evaluations if x.result.floor == floor}
        for floor in (True, False)
    )
    split = config["split"]
    title = f"{source.name}, {SPLITS[split]}, {config['horizon']:g} s open loop"
    figure = trajectory_figure(
        truth,
        predictions,
        trajectory=config["trajectory"],
        title=f"{source.name}, {split} trajectory {config['trajectory']}, open loop",
        labels=source.labels,
        input_labels=source.input_labels,
        floors={name: item for name, item in floors.items() if name == lowest},
    )
    save(figure, folder / "trajectory.png")
    label = with_unit(ERROR, source.labels)
    figure = error_figure(predictions, floors=floors, title=title, label=label)
    save(figure, folder / "error.png")
    for label, prediction in predictions.items():
        if prediction.members is not None:
            figure = spread_figure(
                prediction, title=f"{title}\n{label}, {len(prediction.members)} members"
            )
            save(figure, folder / f"spread_{label.replace(' ', '_')}.png")


def write_intervals(
    evaluations: list[Evaluation], source: DataSource, split: str, folder: Path
) -> dict[str, dict[float, Calibration]]:
    """Write what the intervals of predictions hold; returns it by run and window."""
    intervals = {item.result.run: item.intervals for item in evaluations if item.intervals}
    if intervals:
        write_table(calibration_table(intervals), folder, "calibration")
        title = f"{source.name}: intervals of predictions on {SPLITS[split]}"
        save(calibration_figure(intervals, title=title), folder / "calibration.png")
    return intervals


def compare_with_truth(
    evaluations: list[Evaluation], source: DataSource, folder: Path
) -> dict[str, TermComparison]:
    """Write learned against true terms of each structured model; returns them by its label."""
    if source.system is None or not source.configurations:
        return {}
    names = list(source.configurations)
    q = torch.tensor([source.configurations[name] for name in names], dtype=torch.float64)
    comparisons = {}
    for item in evaluations:
        model = item.model
        if not isinstance(model, MechanicalSystem):
            continue
        comparison = compare_terms(model, source.system, q, names=names)
        label = item.result.run
        comparisons[label] = comparison
        stem = label.replace(" ", "_")
        write_table(comparison.to_frame(), folder, f"terms_{stem}")
        for index, name in enumerate(names):
            figure = terms_figure(
                comparison,
                configuration=index,
                title=f"{label}: learned and true terms, {name}",
            )
            save(figure, folder / f"terms_{stem}_{name}.png")
    write_whole(folder / "terms.txt", terms_text(comparisons) + "\n")
    return comparisons


def terms_text(comparisons: dict[str, TermComparison]) -> str:
    """Learned and true terms of each run, for the terminal."""
    return "\n\n".join(
        f"{label}: learned and true terms\n{item.to_text()}" for label, item in comparisons.items()
    )
