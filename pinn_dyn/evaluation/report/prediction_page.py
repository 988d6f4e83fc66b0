"""The page of an evaluation: trained models on trajectories that no training saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd
from markupsafe import Markup

from pinn_dyn.evaluation.calibration import Calibration, calibration_figure
from pinn_dyn.evaluation.drawing import units, with_unit
from pinn_dyn.evaluation.figures import ERROR, prediction_errors, terms_figure, trajectory_panels
from pinn_dyn.evaluation.identification import OPEN
from pinn_dyn.evaluation.learned_terms import TermComparison
from pinn_dyn.evaluation.metrics import diverged_trajectories
from pinn_dyn.evaluation.prediction import Prediction
from pinn_dyn.evaluation.report.error_curves import error_section
from pinn_dyn.evaluation.report.motion import motion_figure, shown_motions
from pinn_dyn.evaluation.report.page import (
    Origin,
    Section,
    details,
    drawing,
    figure,
    page,
    paragraph,
    table,
    turned,
)
from pinn_dyn.evaluation.tables import beaten_by_floors, best, best_floor, bracketed
from pinn_dyn.mechanics import Trajectory

_HEADERS = {
    "run": "run",
    "seed": "seed",
    "pairs": "training pairs",
    "error_mean": "mean error ± std",
    "error_median": "median",
    "error_worst": "worst trajectory",
    "diverged": "diverged",
    "left_data": "left the data",
    "left_data_after": "first after [s]",
    "torque_share": "torque error / spread",
    "residual_share": "share of the residual force",
    "member_error_mean": "mean error of a member",
    "member_error_std": "its std over the members",
    "spread_over_error": "spread of the members / error",
    "input_delay_seconds": "learned input delay [s]",
    "training_seconds": "training [s]",
}
_GROUP_HEADERS = {
    "model": "model",
    "seeds": "seeds",
    "mean_error_mean": "mean error, mean over seeds",
    "worst_error_mean": "worst seed",
    "worst_error_worst": "worst trajectory of all",
}
# Of a table what it says, and the headings of its columns.
_TORQUE = (
    "Inverse dynamics on the same motions, τ = A(q) u: an arm that hardly moves may predict "
    "its torques well and its motion badly, or the other way round.",
    {
        "run": "run",
        "joint": "joint",
        "torque_rms": "RMS of τ̂ − τ",
        "torque_spread": "spread of τ",
        "torque_share": "RMS / spread",
    },
)
_PARTS = (
    "What the parts of a sum contribute along the test motions. A network with a large share "
    "says that the known mechanics leave something out, or that its constants are not found.",
    {
        "run": "run",
        "term": "term",
        "part": "part",
        "rms": "RMS of its force",
        "share": "share of all parts",
    },
)


def prediction_report(
    *,
    title: str,
    trajectories: str,
    summary: pd.DataFrame,
    grouped: pd.DataFrame,
    notes: Sequence[str],
    truth: Trajectory,
    predictions: Mapping[str, Prediction],
    trajectory: int,
    labels: Sequence[str],
    input_labels: Sequence[str],
    comparisons: Mapping[str, TermComparison],
    joints: pd.DataFrame,
    constants: Mapping[str, pd.DataFrame],
    parts: pd.DataFrame,
    intervals: Mapping[str, Mapping[float, Calibration]],
    origin: Origin,
) -> str:
    """The page as HTML text.

    Args:
        title: its heading.
        trajectories: what they are, and how many, for the line below it.
        summary: one row per run, as :func:`pinn_dyn.evaluation.summary_table` makes it.
        grouped: one row per model, as :func:`pinn_dyn.evaluation.grouped_table` makes it.
        notes: what to know of some of the rows.
        truth: the K trajectories stacked, q ``(K, T, N)``, over the horizon.
        predictions: names of runs and floors, and their roll-outs of the same K trajectories.
        trajectory: which of the K to show first.
        labels, input_labels: name and unit of each coordinate and input.
        comparisons: names of the runs that have terms, and these beside the true ones; empty
            where the truth is not known.
        joints: torque errors, one row per run and joint; empty without any.
        constants: names of the runs whose constants were fitted, and these, as
            :func:`pinn_dyn.evaluation.identification.constants_table` makes them.
        parts: what the parts of sums contribute, one row per run, part and term; empty without any.
        intervals: names of the runs that have members, and the calibration for each window in s.
        origin: where the numbers come from.
    """
    floors = set(summary["run"][summary["floor"]])
    models, below = (
        {name: item for name, item in predictions.items() if (name in floors) == floor}
        for floor in (False, True)
    )
    trained = summary[~summary["floor"]]
    sections = [
        Section("Summary", _summary(summary, grouped, notes, labels)),
        error_section(
            prediction_errors(models, below, with_unit(ERROR, labels)),
            one="trajectory",
            lost="diverged",
        ),
        Section(
            "Trajectories",
            _trajectories(
                trained,
                truth,
                models,
                {name: item for name, item in below.items() if name == best_floor(summary)},
                trajectory,
                labels,
                input_labels,
            ),
        ),
        *([Section("Constants", _constants(constants))] if constants else []),
        *([Section("Torque", _table(joints, *_TORQUE))] if len(joints) else []),
        *([Section("Parts", _table(parts, *_PARTS))] if len(parts) else []),
        *([Section("Intervals", _intervals(intervals))] if intervals else []),
        Section("Learned and true terms", _terms(comparisons)),
        origin.section(),
    ]
    return page(title, f"{trajectories}, {truth.duration:g} s open loop", sections)


def _summary(
    summary: pd.DataFrame, grouped: pd.DataFrame, notes: Sequence[str], labels: Sequence[str]
) -> list[Markup]:
    headers = shown_columns(summary)
    marks = pd.DataFrame({name: best(summary, name) for name in headers})
    unit = units(labels)
    parts = [
        paragraph(
            "The error is ‖q̂ − q‖₂"
            + (f", in the units of q ({unit})" if unit else ", in the units of q")
            + ", of roll-outs from the true initial state under the true input, over all times and "
            "trajectories that did not diverge. Rows in brackets are floors and rivals: what a "
            "model has to beat, or its structure has brought nothing. The best model of a column "
            "is bold if it beats them all. A number under the pointer shows all its digits."
        ),
        table(bracketed(summary), headers=headers, best=marks, spread={"error_mean": "error_std"}),
        *map(paragraph, [*notes, *beaten_by_floors(summary)]),
    ]
    if len(grouped) < len(summary):
        shown = {name: text for name, text in _GROUP_HEADERS.items() if name in grouped}
        marks = pd.DataFrame({name: best(grouped, name) for name in shown})
        parts.append(table(bracketed(grouped), headers=shown, best=marks))
    parts.append(details("All figures of every run (summary.csv)", table(turned(summary, "run"))))
    return parts


def shown_columns(summary: pd.DataFrame) -> dict[str, str]:
    """The columns of the summary that a page and a terminal show, and their headings on the page.

    Args:
        summary: one row per run, as :func:`pinn_dyn.evaluation.summary_table` makes it.
    """
    headers = {name: text for name, text in _HEADERS.items() if name in summary}
    for name in summary:
        if name.startswith("valid_time_"):
            headers[name] = f"valid time, {name.removeprefix('valid_time_')} [s]"
        if name.startswith("window_") and name.endswith("_error_mean"):
            span = name.removeprefix("window_").removesuffix("s_error_mean")
            headers[name] = f"mean error, re-set every {span} s"
    return headers


def _trajectories(
    summary: pd.DataFrame,
    truth: Trajectory,
    predictions: Mapping[str, Prediction],
    floors: Mapping[str, Prediction],
    first: int,
    labels: Sequence[str],
    input_labels: Sequence[str],
) -> list[Markup]:
    states, inputs = trajectory_panels(truth, predictions, labels, input_labels, floors)
    count = len(truth.q)
    worst = {int(row.worst_trajectory): row.run for row in summary.itertuples()}
    shown = shown_motions(count, [first, *worst])
    names = {k: f"{k}" for k in shown}
    drawn = motion_figure(
        [*states, *inputs], names, first=first, what="trajectory", everyone="all runs"
    )
    which = "; ".join(
        f"{run}: {index}"
        for run, index in zip(summary["run"], summary["worst_trajectory"], strict=True)
    )
    text = f"Worst trajectory of each run: {which}."
    if len(shown) < count:
        text += f" Shown are {len(shown)} of {count} trajectories, the worst ones among them."
    lost = [
        f"{name} on {', '.join(map(str, diverged.nonzero()[:, 0].tolist()))}"
        for name, item in predictions.items()
        if (diverged := diverged_trajectories(item)).any()
    ]
    if lost:
        text += f" Diverged: {'; '.join(lost)}. A line is not drawn far outside its panel."
    return [figure(drawn, "figure-trajectory"), paragraph(text)]


def _constants(constants: Mapping[str, pd.DataFrame]) -> list[Markup]:
    headers = {
        "name": "constant",
        "value": "value",
        "low": "95 % from",
        "high": "to",
        "unit": "unit",
        "start": "start",
        "note": "",
    }
    text = (
        "Fitted constants with their 95 % intervals, and the value that each started from, the "
        "middle of its prior. What is not determined keeps the width of the prior, as the data say "
        "next to nothing of it. Sums and ratios at the end are determined where their parts are "
        "not."
    )
    parts = [paragraph(text)]
    for run, frame in constants.items():
        left = frame["known"] < 1 - OPEN
        rows = frame.assign(note=left.map({True: "not determined", False: ""}))
        title = f"{run}: {len(rows)} rows, {int(left.sum())} not determined (constants.csv)"
        parts.append(details(title, table(rows, headers=headers)))
    return parts


def _table(frame: pd.DataFrame, text: str, headers: Mapping[str, str]) -> list[Markup]:
    return [paragraph(text), table(frame, headers=headers)]


def _intervals(intervals: Mapping[str, Mapping[float, Calibration]]) -> list[Markup]:
    text = (
        "How many of the errors lie in intervals that promise to hold some share of them. Widths "
        "are those of the members: of an ensemble, or draws of constants that least squares "
        "fitted. These know nothing of measurement noise, nor of what no member can say. Dashed: "
        "widths that the validation motions needed."
    )
    drawn = calibration_figure(intervals, title="")
    return [paragraph(text), drawing(drawn, "levels of intervals and what they hold")]


def _terms(comparisons: Mapping[str, TermComparison]) -> list[Markup]:
    if not comparisons:
        return [
            paragraph(
                "Nothing to compare: a black box has no terms, and of measured data nobody knows "
                "the true ones."
            )
        ]
    frames = {name: item.to_frame() for name, item in comparisons.items()}
    for name, item in comparisons.items():
        smallest = dict(zip(item.names, item.P_min_eigenvalue.tolist(), strict=True))
        frames[name]["P_min_eigenvalue"] = frames[name]["configuration"].map(smallest)
    rows = pd.concat(frames, names=["run"]).reset_index("run").reset_index(drop=True)
    headers = {
        "run": "run",
        "configuration": "configuration",
        "term": "term X",
        "relative_error_identity": "|X_L − X| / |X|",
        "relative_error_best_P": "|X_L − P X| / |X_L|",
        "P_min_eigenvalue": "smallest eigenvalue of P",
    }
    drawn = [
        (
            f"{name}, {where}",
            terms_figure(item, configuration=k, title=f"{name}: learned and true terms, {where}"),
        )
        for name, item in comparisons.items()
        for k, where in enumerate(item.names)
    ]
    pictures = [details(text, drawing(picture, text)) for text, picture in drawn]
    return [
        paragraph(
            "An equation of motion does not change when it is multiplied by a matrix P(q), so a "
            "model may learn P X in place of the true X: where the second and third rows agree, "
            "the model moves like the truth. Each column has one colour scale, red for positive "
            "and blue for negative entries; the colour follows the square root of an entry."
        ),
        *pictures,
        details("Errors of the terms (terms_*.csv)", table(rows, headers=headers)),
    ]
