"""The page of an evaluation: trained models on trajectories that no training saw."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from pinn_dyn.evaluation.figures import ERROR, trajectory_figure
from pinn_dyn.evaluation.identification import OPEN
from pinn_dyn.evaluation.plots import with_unit
from pinn_dyn.evaluation.report.page import (
    Section,
    details,
    drawing,
    page,
    paragraph,
    slider,
    table,
)
from pinn_dyn.evaluation.tables import SEEDS_COLUMNS, summary_columns, unbeaten_baselines

if TYPE_CHECKING:
    from pinn_dyn.evaluation.evaluation import Evaluation

MAX_TRAJECTORIES = 20
"""Largest number of trajectories that the slider offers."""
_TORQUE = (
    "Error of the inverse dynamics on the same motions: RMS of τ̂ − τ with τ = A(q) u, spread of τ, "
    "and their ratio."
)
_PARTS = (
    "RMS of the forces of the parts of a sum along the test motions. A network with a large share "
    "shows that the known mechanics lack something, or have wrong constants."
)


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
