"""Results of an evaluation on trajectories that no training saw: tables, figures and a page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from pinn_dyn.data import DataSource
from pinn_dyn.evaluation.calibration import Calibration
from pinn_dyn.evaluation.figures import (
    ERROR,
    calibration_figure,
    error_figure,
    modes_figure,
    terms_figure,
    trajectory_figure,
)
from pinn_dyn.evaluation.learned_terms import TermComparison
from pinn_dyn.evaluation.prediction import Prediction
from pinn_dyn.evaluation.report.page import (
    Section,
    details,
    drawing,
    page,
    paragraph,
    slider,
    table,
)
from pinn_dyn.evaluation.tables import (
    SEEDS_COLUMNS,
    preferred_run,
    summary_columns,
    to_text,
    unbeaten_baselines,
    with_unit,
    write_table,
)
from pinn_dyn.identification.constants import OPEN
from pinn_dyn.mechanics import Trajectory
from pinn_dyn.models.modes import Modes
from pinn_dyn.plots import save
from pinn_dyn.whole import write_whole

SPLITS = {"test": "unseen test trajectories", "validation": "validation trajectories"}
MAX_TRAJECTORIES = 20
"""Largest number of trajectories that the slider offers."""
_MODES = 12  # number of modes in the table of the page
_TORQUE = (
    "Error of the inverse dynamics on the same motions: RMS of τ̂ − τ with τ = A(q) u, spread of τ, "
    "and their ratio."
)
_PARTS = (
    "RMS of the forces of the parts of a sum along the test motions. A network with a large share "
    "shows that the known mechanics lack something, or have wrong constants."
)


@dataclass
class Evaluation:
    """Results of an evaluation.

    Attributes:
        source: the data set.
        split: ``test`` or ``validation``.
        truth: the K trajectories stacked, q ``(K, T, N)``.
        summary: one row per run and baseline, with all metrics.
        by_model: mean and standard deviation over seeds.
        torque: torque errors, one row per run and joint; empty without mechanical models.
        ensembles: errors and spreads of members, one row per ensemble; empty without ensembles.
        parts: contributions of the parts of sums, one row per run, part and term.
        predictions: rollouts by name of the row, baselines included.
        intervals: calibration by run and window in s; runs without members have none.
        terms: learned terms beside the true ones, by run; empty where the truth is unknown.
        modes: modes of the models of oscillators at the mean input, by run.
        constants: tables of fitted constants, by run.
        origin: command, commit, data and configurations, for the page.
    """

    source: DataSource
    split: str
    truth: Trajectory
    summary: pd.DataFrame
    by_model: pd.DataFrame
    torque: pd.DataFrame
    ensembles: pd.DataFrame
    parts: pd.DataFrame
    predictions: dict[str, Prediction]
    intervals: dict[str, dict[float, Calibration]]
    terms: dict[str, TermComparison]
    modes: Mapping[str, Modes] = field(default_factory=dict)
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
        """Rollouts of the most accurate baseline with the fewest diverged trajectories."""
        rows = self.summary[self.summary["baseline"]].sort_values(["diverged", "error_mean"])
        return {name: self.predictions[name] for name in rows["run"][:1]}

    @property
    def trajectories(self) -> str:
        """Number and kind of the trajectories, for titles."""
        return f"{len(self.truth.q)} {SPLITS[self.split]}, {self.truth.duration:g} s open loop"

    def __str__(self) -> str:
        lines = [
            f"{self.source.name}: {self.trajectories}",
            to_text(self.summary, summary_columns(self.summary)),
            "* best in its column, and better than all baselines (in brackets)",
            *preferred_run(self.summary),
            *unbeaten_baselines(self.summary),
        ]
        if len(self.by_model) < len(self.summary):
            lines += ["", "over seeds:", to_text(self.by_model, SEEDS_COLUMNS)]
        return "\n".join(lines)

    def figures(self, trajectory: int = 0) -> Iterator[tuple[str, Figure]]:
        """Yield the names of all figures, and the figures; one draws a single ``trajectory``."""
        title = f"{self.source.name}, {self.trajectories}"
        labels = self.source.labels
        yield (
            "trajectory",
            trajectory_figure(
                self.truth,
                self.models,
                trajectory=trajectory,
                title=f"{self.source.name}, {self.split} trajectory {trajectory}, open loop",
                labels=labels,
                input_labels=self.source.input_labels,
                baselines=self.best_baseline,
            ),
        )
        error = with_unit(ERROR, labels)
        figure = error_figure(self.models, baselines=self.baselines, title=title, label=error)
        yield "error", figure
        if self.intervals:
            yield "calibration", calibration_figure(self.intervals, title=title)
        for run, comparison in self.terms.items():
            for k, name in enumerate(comparison.names):
                text = f"{run}: learned and true terms, {name}"
                figure = terms_figure(comparison, configuration=k, title=text)
                yield f"terms_{_stem(run)}_{name}", figure
        for run, modes in self.modes.items():
            text = f"{run}: modes at the mean input"
            yield f"modes_{_stem(run)}", modes_figure(modes, title=text, labels=labels)

    def save(self, folder: str | Path, trajectory: int = 0) -> None:
        """Write the tables as CSV, the figures as PNG, and the page ``report.html``."""
        folder, labels = Path(folder), self.source.labels
        tables = {
            "summary": self.summary,
            "by_model": self.by_model,
            "torque": self.torque,
            "ensembles": self.ensembles,
            "parts": self.parts,
        }
        tables |= {f"terms_{_stem(run)}": x.to_frame() for run, x in self.terms.items()}
        tables |= {f"modes_{_stem(run)}": x.to_frame(labels) for run, x in self.modes.items()}
        for stem, frame in tables.items():
            if len(frame):
                write_table(frame, folder, stem)
        figures = dict(self.figures(trajectory))
        for name, figure in figures.items():
            save(figure, folder / f"{name}.png")
        write_whole(folder / "report.html", prediction_report(self, figures, trajectory))


def _stem(run: str) -> str:
    return "".join(c if c.isalnum() or c in "-.=" else "_" for c in run)


def prediction_report(
    evaluation: Evaluation, figures: Mapping[str, Figure], trajectory: int
) -> str:
    """Return the page as HTML text, with its figures by name; it first shows ``trajectory``."""
    item = evaluation
    sections = {
        "Summary": _summary(item),
        "Error over time": [drawing(figures["error"], "error over time")],
        "Trajectories": _trajectories(item, trajectory),
        "Constants": _constants(item.constants),
        "Torque": _table(item.torque, _TORQUE),
        "Parts": _table(item.parts, _PARTS),
        "Intervals": _intervals(item, figures),
        "Learned and true terms": _terms(item, figures),
        "Modes": _modes(item, figures),
    }
    pages = [Section(title, [*parts]) for title, parts in sections.items()]
    pages = [section for section in pages if section.parts]
    pages += [] if item.origin is None else [item.origin.section()]
    title = f"{item.source.name}: trained models on unseen motions"
    return page(title, item.trajectories, pages)


def _summary(item: Evaluation) -> Iterator[Markup]:
    yield paragraph(
        f"The error is {with_unit(ERROR, item.source.labels)}. Each rollout starts from the true "
        "initial state and gets the true input. Means are over all times and all trajectories that "
        "did not diverge. Baselines are in brackets. The best model of a column is bold if it is "
        "better than all baselines. All columns are in summary.csv."
    )
    yield table(item.summary, headers=summary_columns(item.summary))
    yield from map(paragraph, preferred_run(item.summary))
    yield from map(paragraph, unbeaten_baselines(item.summary))
    if len(item.by_model) < len(item.summary):
        yield table(item.by_model, headers=SEEDS_COLUMNS)


def _trajectories(item: Evaluation, first: int) -> Iterator[Markup]:
    trained = item.summary[~item.summary["baseline"]]
    worst = dict(zip(trained["run"], trained["worst_trajectory"], strict=True))
    order = {
        run: x.error().mean(dim=1).nan_to_num(math.inf).argsort() for run, x in item.models.items()
    }
    median = {run: int(indices[len(indices) // 2]) for run, indices in order.items()}
    count = len(item.truth.q)
    offered = dict.fromkeys([first, *worst.values(), *median.values(), *range(count)])
    numbers = list(offered)[:MAX_TRAJECTORIES]
    figures = (
        trajectory_figure(
            item.truth,
            item.models,
            trajectory=number,
            title="",
            labels=item.source.labels,
            input_labels=item.source.input_labels,
            baselines=item.best_baseline,
        )
        for number in numbers
    )
    yield slider(zip(numbers, figures, strict=True), "trajectory")
    for name, indices in (("Median", median), ("Worst", worst)):
        lines = "; ".join(f"{run}: {index}" for run, index in indices.items())
        yield paragraph(f"{name} trajectory of each run: {lines}.")


def _constants(constants: Mapping[str, pd.DataFrame]) -> Iterator[Markup]:
    if constants:
        yield paragraph(
            "Fitted constants with 95 % intervals. The fit starts at the middle of the prior. A "
            "constant that the data do not determine keeps the width of its prior."
        )
    for run, frame in constants.items():
        undetermined = frame["known"] < 1 - OPEN
        rows = frame.assign(note=undetermined.map({True: "not determined", False: ""}))
        title = f"{run}: {len(rows)} rows, {int(undetermined.sum())} not determined (constants.csv)"
        yield details(title, table(rows.drop(columns="known")))


def _table(frame: pd.DataFrame, text: str) -> Iterator[Markup]:
    if len(frame):
        yield paragraph(text)
        frame = frame[["run", *frame.columns.drop("run")]]
        yield table(frame.rename(columns=lambda name: name.replace("_", " ")))  # marks no best row


def _intervals(item: Evaluation, figures: Mapping[str, Figure]) -> Iterator[Markup]:
    if item.intervals:
        yield paragraph(
            "Share of the errors that lie within intervals of each nominal level. The members of "
            "an ensemble, or draws of fitted constants, give the widths. They do not know the "
            "measurement noise. Dashed: widths corrected on the validation motions."
        )
        yield drawing(figures["calibration"], "nominal levels of intervals and their coverage")


def _terms(item: Evaluation, figures: Mapping[str, Figure]) -> Iterator[Markup]:
    if item.terms:
        yield paragraph(
            "Multiplying the equation of motion by a matrix P(q) does not change it. A model may "
            "therefore learn P X instead of the true X. Where the second and third rows of a "
            "figure agree, the model moves like the truth. Each column has one color scale, red "
            "for positive and blue for negative entries."
        )
    for name, figure in figures.items():
        if name.startswith("terms_"):
            title = figure.get_suptitle().splitlines()[0]
            yield details(title, drawing(figure, title))


def _modes(item: Evaluation, figures: Mapping[str, Figure]) -> Iterator[Markup]:
    if item.modes:
        yield paragraph(
            "Eigenfrequencies, damping ratios and shapes of the model, linearized at its "
            "equilibrium under the mean input of the training data. The modes are sorted by their "
            "share: the standard deviation of q due to a mode alone, in relation to the strongest "
            "mode, if the inputs are white noise. Only what recurs with other seeds belongs to the "
            "robot. The files modes_<run>.csv hold all modes."
        )
    for run, modes in item.modes.items():
        title = f"{run}: modes at the mean input"
        yield drawing(figures[f"modes_{_stem(run)}"], title)
        frame = modes.to_frame(item.source.labels).head(_MODES)
        yield details(f"{run}: table of the strongest modes", table(frame))
