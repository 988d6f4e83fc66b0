"""The page of a control run: control laws on learned and on true terms against the robot."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
import torch
from markupsafe import Markup
from matplotlib.figure import Figure

from pinn_dyn.control.record import ClosedLoopRecord
from pinn_dyn.control.stability_report import MEASUREMENT_TOLERANCE
from pinn_dyn.evaluation.control_figures import ERROR, steady_state_figure
from pinn_dyn.evaluation.plots import units, with_unit
from pinn_dyn.evaluation.report.page import (
    Origin,
    Section,
    details,
    drawing,
    from_markdown,
    page,
    paragraph,
    picture,
    table,
    turned,
)

_MAX_ANIMATION = 5e6  # bytes of an animation that is embedded
_HEADERS = {
    "controller": "law",
    "stopped": "stopped",
    "rms_error": "RMS error",
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
    figures: Mapping[str, Figure],
    labels: Sequence[str],
    animation: Path | None,
    stability: StabilityResult | None,
    origin: Origin,
) -> str:
    """Return the page as HTML text.

    Args:
        title: heading of the page.
        summary: one row per law, see :func:`pinn_dyn.evaluation.comparison_table`.
        coordinates, inputs: the same per coordinate and per input.
        records: names of laws and the records of their runs.
        figures: names and figures to show.
        labels: name and unit of each coordinate.
        animation: GIF of the first law, or None.
        stability: results of the stability analysis, or None.
        origin: origin of the numbers.
    """
    record = next(iter(records.values()))
    runs = len(record.stopped)
    sections = [
        Section("Summary", [*_summary(summary, coordinates, inputs, records, labels)]),
        Section("Figures", [drawing(figure, name) for name, figure in figures.items()]),
    ]
    if animation is not None:
        sections.append(Section("Animation", [_animation(animation)]))
    if stability is not None:
        sections.append(Section("Stability", [*_stability(stability, labels)]))
    duration = float(record.t[-1] - record.t[0])
    subtitle = f"{runs} run{'s' if runs > 1 else ''} of {duration:g} s"
    return page(title, subtitle, [*sections, origin.section()])


def measured_model_report(*, title: str, report: str, origin: Origin) -> str:
    """Return the page of a model of measured data, for which there is no robot to control.

    Args:
        title: heading of the page.
        report: analysis of the model, in Markdown.
        origin: origin of the numbers.
    """
    subtitle = "measured data: there is no robot to close the loop with"
    return page(title, subtitle, [Section("Model", [from_markdown(report)]), origin.section()])


def shown_columns(summary: pd.DataFrame) -> dict[str, str]:
    """Return the columns of the summary that a page and a terminal show, with their headings.

    Args:
        summary: one row per law, see :func:`pinn_dyn.evaluation.comparison_table`.
    """
    return {name: header for name, header in _HEADERS.items() if name in summary}


def _summary(
    summary: pd.DataFrame,
    coordinates: pd.DataFrame,
    inputs: pd.DataFrame,
    records: Mapping[str, ClosedLoopRecord],
    labels: Sequence[str],
) -> Iterator[Markup]:
    unit = units(labels)
    yield paragraph(
        "The error is q_ref − q in the units of q"
        + (f" ({unit})" if unit else "")
        + ". Means are over the runs that were not stopped."
    )
    yield table(summary, headers=shown_columns(summary))
    stops = [
        {"law": name, "run": index, "reason": reason}
        for name, record in records.items()
        for index, reason in enumerate(record.stopped)
        if reason is not None
    ]
    if stops:
        yield paragraph("Stopped runs:")
        yield table(pd.DataFrame(stops))
    yield details("All columns (summary.csv)", table(turned(summary, "controller")))
    yield details("Per coordinate (coordinates.csv)", table(coordinates))
    yield details("Per input (inputs.csv)", table(inputs))


def _animation(path: Path) -> Markup:
    if path.stat().st_size > _MAX_ANIMATION:
        return paragraph(f"{path.name} is too large for this page and lies beside it.")
    return picture(path.read_bytes(), "gif", "animation of the first law in real time")


def _stability(result: StabilityResult, labels: Sequence[str]) -> Iterator[Markup]:
    points = result.set_points
    bounded = points[points["holds"] & points["measured_error"].notna()]
    below = int((bounded["measured_error"] <= bounded["bound"] + MEASUREMENT_TOLERANCE).sum())
    yield paragraph(
        f"Proposition 1 of the paper holds at {int(points['holds'].sum())} of {len(points)} set "
        f"points; there {below} of {len(bounded)} measured steady-state errors are below the "
        "predicted bound."
    )
    bound = torch.tensor(points["bound"].where(points["holds"], math.inf).tolist())
    measured = torch.tensor(points["measured_error"].tolist())
    figure = steady_state_figure(
        bound, measured, title="Steady states", label=with_unit(ERROR, labels)
    )
    yield drawing(figure, "steady-state errors against their bounds")
    yield details("Full report (stability.md)", from_markdown(result.report))
