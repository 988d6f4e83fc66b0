"""The page of a control run: laws on learned and on true terms against the robot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import torch
from markupsafe import Markup

from pinn_dyn.control.record import ClosedLoopRecord
from pinn_dyn.control.stability_report import MEASUREMENT_TOLERANCE
from pinn_dyn.evaluation.control_figures import (
    ERROR,
    control_error_panel,
    control_errors,
    control_panels,
    steady_state_figure,
)
from pinn_dyn.evaluation.control_metrics import stopped_runs
from pinn_dyn.evaluation.drawing import units, with_unit
from pinn_dyn.evaluation.report.error_curves import error_section
from pinn_dyn.evaluation.report.motion import motion_figure, shown_motions
from pinn_dyn.evaluation.report.page import (
    Origin,
    Section,
    details,
    drawing,
    figure,
    from_markdown,
    page,
    paragraph,
    picture,
    table,
    turned,
)

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
        error_section(
            control_error_panel(records, with_unit(ERROR, labels)), one="run", lost="stopped"
        ),
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
    unit = units(labels)
    parts = [
        paragraph(
            "The error is q_ref − q"
            + (f", in the units of q ({unit})" if unit else ", in the units of q")
            + ", over the runs that went to their end. A number under the pointer shows all its "
            "digits."
        ),
        table(summary, headers=shown_columns(summary)),
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


def shown_columns(summary: pd.DataFrame) -> dict[str, str]:
    """The columns of the summary that a page and a terminal show, and their headings on the page.

    Args:
        summary: one row per law, as :func:`pinn_dyn.evaluation.comparison_table` makes it.
    """
    headers = {}
    for name in summary:
        if name in _HEADERS:
            headers[name] = _HEADERS[name]
        elif name.startswith("step_error_after_"):
            seconds, kind = name.removeprefix("step_error_after_").split("_s_")
            headers[name] = f"error after {seconds} s, {kind.removesuffix('_percent')} [% of step]"
    return headers


def _motions(
    records: Mapping[str, ClosedLoopRecord],
    run: int,
    held: bool,
    labels: Sequence[str],
    input_labels: Sequence[str],
) -> list[Section]:
    states, inputs = control_panels(records, labels, input_labels, held=held)
    first = next(iter(records.values()))
    shown = shown_motions(len(first.stopped), [run, *map(_worst, records.values())])
    stopped = torch.stack([stopped_runs(record) for record in records.values()]).any(dim=0)
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


def _worst(record: ClosedLoopRecord) -> int:
    """The run with the largest error."""
    return int(control_errors(record).nan_to_num(torch.inf).mean(dim=1).argmax())


def _animation(path: Path, law: str, run: int) -> list[Markup]:
    if path.stat().st_size > _ANIMATION:
        return [paragraph(f"{path.name} is too large for this page; it lies beside it.")]
    text = f"run {run} under the law {law}"
    return [picture(path.read_bytes(), "gif", text), paragraph(f"In real time: {text}.")]


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
    bound = torch.tensor(points["bound"].where(points["holds"], math.inf).tolist())
    measured = torch.tensor(points["measured_error"].tolist())
    error = with_unit(ERROR, labels)
    drawn = steady_state_figure(bound, measured, title="Steady states", label=error)
    return [
        paragraph(text),
        drawing(drawn, "steady-state errors against their bounds"),
        details("The whole report (stability.md)", from_markdown(result.report)),
    ]
