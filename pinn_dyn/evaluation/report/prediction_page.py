"""The page of an evaluation: trained models on trajectories that no training saw."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from pinn_dyn.evaluation.calibration import calibration_figure
from pinn_dyn.evaluation.identification import OPEN
from pinn_dyn.evaluation.metrics import diverged_trajectories
from pinn_dyn.evaluation.plots import units
from pinn_dyn.evaluation.report.browser import MAX_TRAJECTORIES, trajectory_browser
from pinn_dyn.evaluation.report.page import (
    Section,
    details,
    drawing,
    interactive,
    page,
    paragraph,
    table,
    turned,
)
from pinn_dyn.evaluation.tables import SEEDS_COLUMNS, summary_columns

if TYPE_CHECKING:
    from pinn_dyn.evaluation.evaluation import Evaluation

_TORQUE = {
    "run": "run",
    "joint": "joint",
    "torque_rms": "RMS of τ̂ − τ",
    "torque_spread": "spread of τ",
    "torque_share": "RMS / spread",
}
_PARTS = {
    "run": "run",
    "term": "term",
    "part": "part",
    "rms": "RMS of its force",
    "share": "share of all parts",
}
_CONSTANTS = {
    "name": "constant",
    "value": "value",
    "low": "95 % from",
    "high": "to",
    "unit": "unit",
    "start": "start",
    "note": "note",
}
_TERMS = {
    "run": "run",
    "configuration": "configuration",
    "term": "term X",
    "relative_error_identity": "|X_L − X| / |X|",
    "relative_error_best_P": "|X_L − P X| / |X_L|",
    "P_min_eigenvalue": "smallest eigenvalue of P",
}


def prediction_report(
    evaluation: Evaluation, figures: Mapping[str, Figure], trajectory: int
) -> str:
    """Return the page as HTML text.

    Args:
        evaluation: the results.
        figures: its figures by name, see :meth:`Evaluation.figures`.
        trajectory: index of the trajectory that the page shows at first.
    """
    item = evaluation
    sections = {
        "Summary": _summary(item),
        "Error over time": [drawing(figures["error"], "error over time")],
        "Trajectories": _trajectories(item, trajectory),
        "Constants": _constants(item.constants),
        "Torque": _torque(item.torque),
        "Parts": _parts(item.parts),
        "Intervals": _intervals(item),
        "Learned and true terms": _terms(item, figures),
    }
    pages = [Section(title, [*parts]) for title, parts in sections.items()]
    pages = [section for section in pages if section.parts]
    if item.origin is not None:
        pages.append(item.origin.section())
    title = f"{item.source.name}: trained models on unseen motions"
    return page(title, item.trajectories, pages)


def _summary(item: Evaluation) -> Iterator[Markup]:
    unit = units(item.source.labels)
    yield paragraph(
        "The error is ‖q̂ − q‖₂ in the units of q"
        + (f" ({unit})" if unit else "")
        + ". Each rollout starts from the true initial state and gets the true input. Means are "
        "over all times and all trajectories that did not diverge. Baselines are in brackets. The "
        "best model of a column is bold if it is better than all baselines."
    )
    yield table(item.summary, headers=summary_columns(item.summary))
    yield from map(paragraph, item.remarks())
    if len(item.by_model) < len(item.summary):
        yield table(item.by_model, headers=SEEDS_COLUMNS)
    yield details("All columns (summary.csv)", table(turned(item.summary, "run")))


def _trajectories(item: Evaluation, first: int) -> Iterator[Markup]:
    trained = item.summary[~item.summary["baseline"]]
    worst = dict(zip(trained["run"], trained["worst_trajectory"], strict=True))
    count = len(item.truth.q)
    offered = list(dict.fromkeys([first, *worst.values(), *range(count)]))[:MAX_TRAJECTORIES]
    browser = trajectory_browser(
        item.truth,
        item.models,
        item.best_baseline,
        labels=item.source.labels,
        input_labels=item.source.input_labels,
        trajectories=offered,
    )
    yield interactive(browser, "figure-trajectory")
    lines = [f"{run}: {index}" for run, index in worst.items()]
    text = f"Worst trajectory of each run: {'; '.join(lines)}."
    if len(offered) < count:
        text += f" The slider offers {len(offered)} of {count} trajectories."
    for run, prediction in item.models.items():
        if len(lost := diverged_trajectories(prediction).nonzero()):
            text += f" {run} diverged on {', '.join(str(int(k)) for k in lost)}."
    yield paragraph(text)
    yield paragraph("A click on a name of the legend hides or shows its lines.")


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
        yield details(title, table(rows, headers=_CONSTANTS))


def _torque(frame: pd.DataFrame) -> Iterator[Markup]:
    if len(frame):
        yield paragraph(
            "Error of the inverse dynamics on the same motions, with τ = A(q) u. Torques and "
            "motions may be predicted unequally well, for example for an arm that hardly moves."
        )
        yield table(frame, headers=_TORQUE)


def _parts(frame: pd.DataFrame) -> Iterator[Markup]:
    if len(frame):
        yield paragraph(
            "Contributions of the parts of a sum along the test motions. A network with a large "
            "share shows that the known mechanics lack something, or have wrong constants."
        )
        yield table(frame, headers=_PARTS)


def _intervals(item: Evaluation) -> Iterator[Markup]:
    if item.intervals:
        yield paragraph(
            "Share of the errors that lie within intervals of each nominal level. The members of "
            "an ensemble, or draws of fitted constants, give the widths. They do not know the "
            "measurement noise. Dashed: widths corrected on the validation motions."
        )
        figure = calibration_figure(item.intervals, title="")
        yield drawing(figure, "nominal levels of intervals and their coverage")


def _terms(item: Evaluation, figures: Mapping[str, Figure]) -> Iterator[Markup]:
    if not item.terms:
        yield paragraph(
            "There is nothing to compare: a black box has no terms, and the true terms of measured "
            "data are unknown."
        )
        return
    yield paragraph(
        "Multiplying the equation of motion by a matrix P(q) does not change it. A model may "
        "therefore learn P X instead of the true X. Where the second and third rows of a figure "
        "agree, the model moves like the truth. Each column has one color scale, red for positive "
        "and blue for negative entries. The color follows the square root of an entry."
    )
    for name, figure in figures.items():
        if name.startswith("terms_"):
            title = figure.get_suptitle().splitlines()[0]
            yield details(title, drawing(figure, title))
    frames = []
    for run, comparison in item.terms.items():
        smallest = dict(zip(comparison.names, comparison.P_min_eigenvalue.tolist(), strict=True))
        frame = comparison.to_frame().assign(run=run)
        frames.append(frame.assign(P_min_eigenvalue=frame["configuration"].map(smallest)))
    yield details("Errors of the terms (terms_*.csv)", table(pd.concat(frames), headers=_TERMS))
