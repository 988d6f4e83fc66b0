"""The page of an evaluation: trained models on trajectories that no training saw."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd
from markupsafe import Markup

from pinn_dyn.evaluation.learned_terms import TermComparison
from pinn_dyn.evaluation.metrics import diverged_trajectories
from pinn_dyn.evaluation.prediction import Prediction
from pinn_dyn.evaluation.report.error_curves import error_figure
from pinn_dyn.evaluation.report.motion import Line, Panel, motion_figure, shown_motions
from pinn_dyn.evaluation.report.page import (
    Origin,
    Section,
    details,
    figure,
    page,
    paragraph,
    table,
    turned,
    units,
)
from pinn_dyn.evaluation.report.style import DARK, GREY, colour, dash
from pinn_dyn.evaluation.report.terms import terms_figure
from pinn_dyn.evaluation.tables import _best
from pinn_dyn.mechanics import Trajectory

_HEADERS = {
    "run": "run",
    "seed": "seed",
    "pairs": "training pairs",
    "error_mean": "mean error ± std",
    "error_median": "median",
    "error_worst": "worst trajectory",
    "diverged": "diverged",
    "training_seconds": "training [s]",
}
_GROUP_HEADERS = {
    "model": "model",
    "seeds": "seeds",
    "mean_error_mean": "mean error, mean over seeds",
    "worst_error_mean": "worst seed",
    "worst_error_worst": "worst trajectory of all",
}


def prediction_report(
    *,
    title: str,
    trajectories: str,
    summary: pd.DataFrame,
    grouped: pd.DataFrame,
    truth: Trajectory,
    predictions: Mapping[str, Prediction],
    trajectory: int,
    labels: Sequence[str],
    input_labels: Sequence[str],
    comparisons: Mapping[str, TermComparison],
    origin: Origin,
) -> str:
    """The page as HTML text.

    Args:
        title: its heading.
        trajectories: what they are, and how many, for the line below it.
        summary: one row per run, as :func:`pinn_dyn.evaluation.summary_table` makes it.
        grouped: one row per model, as :func:`pinn_dyn.evaluation.grouped_table` makes it.
        truth: the K trajectories stacked, q ``(K, T, N)``, over the horizon.
        predictions: names of runs and their roll-outs of the same K trajectories.
        trajectory: which of the K to show first.
        labels, input_labels: name and unit of each coordinate and input.
        comparisons: names of the runs that have terms, and these beside the true ones; empty
            where the truth is not known.
        origin: where the numbers come from.
    """
    sections = [
        Section("Summary", _summary(summary, grouped, labels)),
        Section("Error over time", _errors(predictions, labels)),
        Section(
            "Trajectories",
            _trajectories(summary, truth, predictions, trajectory, labels, input_labels),
        ),
        Section("Learned and true terms", _terms(comparisons)),
        origin.section(),
    ]
    return page(title, f"{trajectories}, {truth.duration:g} s open loop", sections)


def _summary(summary: pd.DataFrame, grouped: pd.DataFrame, labels: Sequence[str]) -> list[Markup]:
    headers = {name: text for name, text in _HEADERS.items() if name in summary}
    for name in summary:
        if name.startswith("window_") and name.endswith("_error_mean"):
            span = name.removeprefix("window_").removesuffix("s_error_mean")
            headers[name] = f"mean error, re-set every {span} s"
    best = pd.DataFrame({name: _best(summary, name) for name in headers})
    unit = units(labels)
    parts = [
        paragraph(
            "The error is ‖q̂ − q‖₂"
            + (f", in the units of q ({unit})" if unit else ", in the units of q")
            + ", of roll-outs from the true initial state under the true input, over all times and "
            "trajectories that did not diverge. The best figure of a column is bold; a "
            "number under the pointer shows all its digits."
        ),
        table(summary, headers=headers, best=best, spread={"error_mean": "error_std"}),
    ]
    if len(grouped) < len(summary):
        shown = {name: text for name, text in _GROUP_HEADERS.items() if name in grouped}
        marks = pd.DataFrame({name: _best(grouped, name) for name in shown})
        parts.append(table(grouped, headers=shown, best=marks))
    parts.append(details("All figures of every run (summary.csv)", table(turned(summary, "run"))))
    return parts


def _errors(predictions: Mapping[str, Prediction], labels: Sequence[str]) -> list[Markup]:
    curves = {
        name: (item.t, item.error(), diverged_trajectories(item))
        for name, item in predictions.items()
    }
    drawn = error_figure(
        curves, label=_with_unit("‖q̂ − q‖₂", labels), one="trajectory", lost="diverged"
    )
    text = "A click on a name of the legend hides or shows it, a double click leaves it alone."
    return [figure(drawn, "figure-error"), paragraph(text)]


def _trajectories(
    summary: pd.DataFrame,
    truth: Trajectory,
    predictions: Mapping[str, Prediction],
    first: int,
    labels: Sequence[str],
    input_labels: Sequence[str],
) -> list[Markup]:
    panels = []
    for k, label in enumerate(labels):
        real = Line("truth", truth.t, truth.q[..., k], GREY, width=4, always=True)
        guesses = [
            Line(name, item.t, item.q_hat[..., k], colour(index), dash(index))
            for index, (name, item) in enumerate(predictions.items())
        ]
        panels.append(Panel(label, [real, *guesses], leading=real))
    distances = [
        Line(name, item.t, item.error(), colour(index), dash(index))
        for index, (name, item) in enumerate(predictions.items())
    ]
    panels.append(Panel(_with_unit("‖q̂ − q‖₂", labels), distances, log=True))
    held = truth.input.interpolation == "hold"
    for k, label in enumerate(input_labels):
        line = Line("input", truth.t, truth.u[..., k], DARK, held=held, always=True)
        panels.append(Panel(label, [line]))
    count = len(truth.q)
    worst = {int(row.worst_trajectory): row.run for row in summary.itertuples()}
    shown = shown_motions(count, [first, *worst])
    names = {k: f"{k}" for k in shown}
    drawn = motion_figure(panels, names, first=first, what="trajectory", everyone="all runs")
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
    points = next(iter(comparisons.values()))
    where = "; ".join(
        f"{name}: ({', '.join(f'{value:.4g}' for value in q.tolist())})"
        for name, q in zip(points.names, points.q, strict=True)
    )
    return [
        paragraph(
            "An equation of motion does not change when it is multiplied by a matrix P(q), so a "
            "model may learn P X in place of the true X: where the second and third columns agree, "
            "the model moves like the truth (of M⁻¹ the third is (P M)⁻¹). Each row has one colour "
            "scale, red for positive and blue for negative entries; the colour follows the square "
            "root of an entry."
        ),
        paragraph(f"Configurations q: {where}."),
        figure(terms_figure(comparisons), "figure-terms", wide=True),
        details("Errors of the terms (terms_*.csv)", table(rows, headers=headers)),
    ]


def _with_unit(text: str, labels: Sequence[str]) -> str:
    unit = units(labels)
    return f"{text} [{unit}]" if unit else text
