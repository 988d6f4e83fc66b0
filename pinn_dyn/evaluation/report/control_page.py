"""The page of a control run: laws on learned and on true terms against the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import plotly.graph_objects as go
import torch
from markupsafe import Markup
from torch import Tensor

from pinn_dyn.control.record import ClosedLoopRecord
from pinn_dyn.control.stability_report import MEASUREMENT_TOLERANCE
from pinn_dyn.evaluation.control_metrics import stopped_runs
from pinn_dyn.evaluation.report.error_curves import error_figure
from pinn_dyn.evaluation.report.motion import Line, Panel, motion_figure, shown_motions
from pinn_dyn.evaluation.report.page import (
    Origin,
    Section,
    details,
    figure,
    from_markdown,
    page,
    paragraph,
    picture,
    table,
    turned,
    units,
)
from pinn_dyn.evaluation.report.style import DARK, GREY, calm, colour, dash

_ANIMATION = 5e6  # bytes of the largest animation that is embedded
_HEADERS = {
    "controller": "law",
    "stopped": "stopped",
    "rms_error": "RMS error",
    "max_error": "largest error",
    "settling_time_worst_s": "settled, worst [s]",
    "overshoot_worst_percent": "overshoot, worst [%]",
    "steady_state_error_percent": "steady-state error [% of step]",
    "input_rms": "RMS input",
    "input_peak": "largest input",
    "saturated_percent": "saturated [%]",
}


@dataclass(frozen=True)
class StabilityResult:
    """Proposition 1 over a region, and steady states against their bounds.

    Attributes:
        report: the report in Markdown.
        set_points: one row per set point with ``bound``, ``holds`` and ``measured_error``.
    """

    report: str
    set_points: pd.DataFrame


def control_report(
    *,
    title: str,
    summary: pd.DataFrame,
    coordinates: pd.DataFrame,
    inputs: pd.DataFrame,
    records: Mapping[str, ClosedLoopRecord],
    run: int,
    held: bool,
    labels: Sequence[str],
    input_labels: Sequence[str],
    animation: Path | None,
    stability: StabilityResult | None,
    origin: Origin,
) -> str:
    """The page as HTML text.

    Args:
        title: its heading.
        summary: one row per law, as :func:`pinn_dyn.evaluation.comparison_table` makes it.
        coordinates, inputs: the same per coordinate and per input.
        records: names of laws and what their K closed loops left behind.
        run: which of the K to show first, and which the animation shows.
        held: whether the input holds between two samples, as under a law at a rate.
        labels, input_labels: name and unit of each coordinate and input.
        animation: a GIF of the first law, or None.
        stability: where it was asked for.
        origin: where the numbers come from.
    """
    record = next(iter(records.values()))
    runs = len(record.stopped)
    sections = [
        Section("Summary", _summary(summary, coordinates, inputs, records, labels)),
        Section("Error over time", _errors(records, labels)),
        *_motions(records, run, held, labels, input_labels),
    ]
    if animation is not None:
        sections.append(Section("Animation", _animation(animation, next(iter(records)), run)))
    if stability is not None:
        sections.append(Section("Stability", _stability(stability, labels)))
    duration = float(record.t[-1] - record.t[0])
    subtitle = f"{runs} run{'s' if runs > 1 else ''} of {duration:g} s"
    return page(title, subtitle, [*sections, origin.section()])


def measured_model_report(*, title: str, report: str, origin: Origin) -> str:
    """The page of a model of measured data, with which no loop can be closed.

    Args:
        title: its heading.
        report: what can be said of the model alone, in Markdown.
        origin: where the numbers come from.
    """
    subtitle = "measured data: there is no robot to close the loop with"
    sections = [Section("The model alone", [from_markdown(report)]), origin.section()]
    return page(title, subtitle, sections)


def _summary(
    summary: pd.DataFrame,
    coordinates: pd.DataFrame,
    inputs: pd.DataFrame,
    records: Mapping[str, ClosedLoopRecord],
    labels: Sequence[str],
) -> list[Markup]:
    headers = {}
    for name, text in _HEADERS.items():
        if name in summary:
            headers[name] = text
        if name == "max_error":
            headers |= {step: _step_header(step) for step in summary if _is_step_error(step)}
    unit = units(labels)
    parts = [
        paragraph(
            "The error is q_ref − q"
            + (f", in the units of q ({unit})" if unit else ", in the units of q")
            + ", over the runs that went to their end. A number under the pointer shows all its "
            "digits."
        ),
        table(summary, headers=headers),
    ]
    stops = pd.DataFrame(
        [
            {"law": name, "run": index, "stopped": reason}
            for name, record in records.items()
            for index, reason in enumerate(record.stopped)
            if reason is not None
        ]
    )
    if len(stops):
        parts += [paragraph("Runs that were stopped:"), table(stops)]
    for text, frame in (
        ("All figures of every law (summary.csv)", turned(summary, "controller")),
        ("Per coordinate (coordinates.csv)", coordinates),
        ("Per input (inputs.csv)", inputs),
    ):
        parts.append(details(text, table(frame)))
    return parts


def _is_step_error(name: str) -> bool:
    return name.startswith("step_error_after_")


def _step_header(name: str) -> str:
    seconds, kind = name.removeprefix("step_error_after_").split("_s_")
    return f"error after {seconds} s, {kind.removesuffix('_percent')} [% of step]"


def _errors(records: Mapping[str, ClosedLoopRecord], labels: Sequence[str]) -> list[Markup]:
    curves = {
        name: (record.t, _distance(record), stopped_runs(record))
        for name, record in records.items()
    }
    drawn = error_figure(curves, label=_error_label(labels), one="run", lost="stopped")
    text = "A click on a name of the legend hides or shows it, a double click leaves it alone."
    return [figure(drawn, "figure-error"), paragraph(text)]


def _motions(
    records: Mapping[str, ClosedLoopRecord],
    run: int,
    held: bool,
    labels: Sequence[str],
    input_labels: Sequence[str],
) -> list[Section]:
    laws = [(name, record, colour(k), dash(k)) for k, (name, record) in enumerate(records.items())]
    first = laws[0][1]
    states = []
    for k, label in enumerate(labels):
        lines = [Line(name, r.t, r.q[..., k], c, d) for name, r, c, d in laws]
        wanted = Line("reference", first.t, first.reference.q[..., k], DARK, "dot", always=True)
        states.append(Panel(label, [*lines, wanted]))
    errors = [Line(name, r.t, _distance(r), c, d) for name, r, c, d in laws]
    states.append(Panel(_error_label(labels), errors, log=True))
    inputs = [
        Panel(label, [Line(name, r.t, r.u[..., k], c, d, held=held) for name, r, c, d in laws])
        for k, label in enumerate(input_labels)
    ]
    shown = shown_motions(len(first.stopped), [run, *(int(_worst(r)) for _, r, _, _ in laws)])
    stopped = torch.stack([stopped_runs(record) for _, record, _, _ in laws]).any(dim=0)
    names = {k: f"{k} stopped" if stopped[k] else f"{k}" for k in shown}
    count = len(first.stopped)
    rest = f" Shown are {len(shown)} of {count} runs." if len(shown) < count else ""
    sections = []
    for title, name, panels, text in (
        ("Motion", "figure-motion", states, "The reference is dotted." + rest),
        (
            "Inputs",
            "figure-inputs",
            inputs,
            "A short peak may leave its panel: a double click into the panel shows all of it."
            + (" The input is held between two control instants." if held else "")
            + rest,
        ),
    ):
        drawn = motion_figure(panels, names, first=run, what="run", everyone="all laws")
        sections.append(Section(title, [figure(drawn, name), paragraph(text)]))
    return sections


def _worst(record: ClosedLoopRecord) -> Tensor:
    """The run with the largest error."""
    return _distance(record).nan_to_num(torch.inf).mean(dim=1).argmax()


def _distance(record: ClosedLoopRecord) -> Tensor:
    return (record.reference.q - record.q).double().norm(dim=-1)


def _error_label(labels: Sequence[str]) -> str:
    unit = units(labels)
    return f"‖q_ref − q‖₂ [{unit}]" if unit else "‖q_ref − q‖₂"


def _animation(path: Path, law: str, run: int) -> list[Markup]:
    if path.stat().st_size > _ANIMATION:
        return [paragraph(f"{path.name} is too large for this page; it lies beside it.")]
    text = f"run {run} under the law {law}"
    return [picture(path, text), paragraph(f"In real time: {text}.")]


def _stability(result: StabilityResult, labels: Sequence[str]) -> list[Markup]:
    points = result.set_points
    bounded = points[points["holds"] & points["measured_error"].notna()]
    allowed = bounded["bound"] + MEASUREMENT_TOLERANCE
    below = int((bounded["measured_error"] <= allowed).sum())
    text = (
        f"Proposition 1 of the paper holds at {int(points['holds'].sum())} of {len(points)} set "
        f"points; there {below} of {len(bounded)} measured steady-state errors are below the "
        "predicted bound."
    )
    return [
        paragraph(text),
        figure(_steady_states(bounded, labels), "figure-stability"),
        details("The whole report (stability.md)", from_markdown(result.report)),
    ]


def _steady_states(points: pd.DataFrame, labels: Sequence[str]) -> go.Figure:
    """Measured steady-state errors against their bounds, on two logarithmic axes."""
    drawn = go.Figure()
    drawn.add_scatter(
        x=points["bound"],
        y=points["measured_error"],
        customdata=points.index,
        mode="markers",
        marker={"color": colour(0), "size": 8, "opacity": 0.7},
        name="set points",
        hovertemplate="run %{customdata}<br>bound %{x:.3g}<br>measured %{y:.3g}<extra></extra>",
    )
    if len(points):
        ends = [points["bound"].min(), points["bound"].max()]
        grey = {"color": GREY, "dash": "dash", "width": 1}
        drawn.add_scatter(x=ends, y=ends, mode="lines", name="error = bound", line=grey)
    label = _error_label(labels)
    drawn.update_xaxes(type="log", title=f"predicted bound on {label}")
    drawn.update_yaxes(type="log", title=f"measured {label}")
    return calm(drawn).update_layout(height=460, margin={"t": 20, "b": 90}, legend={"y": -0.2})
