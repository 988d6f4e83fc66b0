"""Sections of the page of an evaluation."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from pinn_dyn.evaluation.figures import ERROR
from pinn_dyn.evaluation.report.page import details, drawing, paragraph, slider, table
from pinn_dyn.evaluation.tables import (
    SEEDS_COLUMNS,
    preferred_run,
    summary_columns,
    unbeaten_baselines,
    with_unit,
)
from pinn_dyn.identification.constants import OPEN
from pinn_dyn.models.modes import Modes

_MODES = 12  # number of modes in the table of the page


def summary_parts(
    summary: pd.DataFrame, by_model: pd.DataFrame, labels: list[str]
) -> Iterator[Markup]:
    """Yield the table of all runs and baselines, and the table over seeds."""
    yield paragraph(
        f"The error is {with_unit(ERROR, labels)}. Each rollout starts from the true "
        "initial state and gets the true input. Means are over all times and all trajectories that "
        "did not diverge. Baselines are in brackets. The best model of a column is bold if it is "
        "better than all baselines. All columns are in summary.csv."
    )
    yield table(summary, headers=summary_columns(summary))
    yield from map(paragraph, preferred_run(summary))
    yield from map(paragraph, unbeaten_baselines(summary))
    if len(by_model) < len(summary):
        yield table(by_model, headers=SEEDS_COLUMNS)


def trajectory_parts(
    figures: Iterable[tuple[int, Figure]],
    median: Mapping[str, int],
    worst: Mapping[str, int],
) -> Iterator[Markup]:
    """Yield a slider over numbered trajectories, and the numbers of each run."""
    yield slider(figures, "trajectory")
    for name, indices in (("Median", median), ("Worst", worst)):
        lines = "; ".join(f"{run}: {index}" for run, index in indices.items())
        yield paragraph(f"{name} trajectory of each run: {lines}.")


def constants_parts(constants: Mapping[str, pd.DataFrame]) -> Iterator[Markup]:
    """Yield the table of fitted constants of each run."""
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


def table_parts(frame: pd.DataFrame, text: str) -> Iterator[Markup]:
    """Yield a text and a table, or nothing for an empty table."""
    if len(frame):
        yield paragraph(text)
        frame = frame[["run", *frame.columns.drop("run")]]
        yield table(frame.rename(columns=lambda name: name.replace("_", " ")))  # marks no best row


def interval_parts(figure: Figure | None) -> Iterator[Markup]:
    """Yield the figure of the calibration, or nothing."""
    if figure is not None:
        yield paragraph(
            "Share of the errors that lie within intervals of each nominal level. The members of "
            "an ensemble, or draws of fitted constants, give the widths. They do not know the "
            "measurement noise. Dashed: widths corrected on the validation motions."
        )
        yield drawing(figure, "nominal levels of intervals and their coverage")


def term_parts(figures: list[Figure]) -> Iterator[Markup]:
    """Yield the figures of learned and true terms."""
    if figures:
        yield paragraph(
            "Multiplying the equation of motion by a matrix P(q) does not change it. A model may "
            "therefore learn P X instead of the true X. Where the second and third rows of a "
            "figure agree, the model moves like the truth. Each column has one color scale, red "
            "for positive and blue for negative entries."
        )
    for figure in figures:
        title = figure.get_suptitle().splitlines()[0]
        yield details(title, drawing(figure, title))


def mode_parts(
    modes_by_run: Mapping[str, Modes], figures: list[Figure], labels: list[str]
) -> Iterator[Markup]:
    """Yield the figure and the table of the modes of each run."""
    if modes_by_run:
        yield paragraph(
            "Eigenfrequencies, damping ratios and shapes of the model, linearized at its "
            "equilibrium under the mean input of the training data. The modes are sorted by their "
            "share: the standard deviation of q due to a mode alone, in relation to the strongest "
            "mode, if the inputs are white noise. Only what recurs with other seeds belongs to the "
            "robot. The files modes_<run>.csv hold all modes."
        )
    for (run, modes), figure in zip(modes_by_run.items(), figures, strict=True):
        yield drawing(figure, f"{run}: modes at the mean input")
        frame = modes.to_frame(labels).head(_MODES)
        yield details(f"{run}: table of the strongest modes", table(frame))
