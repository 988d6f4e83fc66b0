"""The page of a control run: control laws on learned and on true terms against the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from pinn_dyn.evaluation.closed_loops import ControlResult
from pinn_dyn.evaluation.report.page import (
    Origin,
    Section,
    details,
    drawing,
    page,
    paragraph,
    picture,
    table,
)
from pinn_dyn.evaluation.tables import units

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


def control_report(
    *,
    title: str,
    result: ControlResult,
    figures: Mapping[str, Figure],
    labels: Sequence[str],
    animation: Path | None,
    origin: Origin,
) -> str:
    """Return the page as HTML text.

    ``animation`` is a GIF of the first law, or None.
    """
    sections = [
        Section("Summary", _summary(result, labels)),
        Section("Figures", [drawing(figure, name) for name, figure in figures.items()]),
    ]
    if animation is not None:
        gif = picture(animation.read_bytes(), "gif", "animation of the first law in real time")
        sections.append(Section("Animation", [gif]))
    record = next(iter(result.records.values()))
    runs, duration = len(record.stopped), float(record.t[-1] - record.t[0])
    subtitle = f"{runs} run{'s' if runs > 1 else ''} of {duration:g} s"
    return page(title, subtitle, [*sections, origin.section()])


def shown_columns(summary: pd.DataFrame) -> dict[str, str]:
    """Return the columns of a summary that a page and a terminal show, with their headings."""
    return {name: header for name, header in _HEADERS.items() if name in summary}


def _summary(result: ControlResult, labels: Sequence[str]) -> list[Markup]:
    summary, unit = result.table, units(labels)
    text = "The error is q_ref − q in the units of q" + (f" ({unit})" if unit else "")
    parts = [
        paragraph(
            f"{text}. Means are over runs that were not stopped. All columns are in summary.csv."
        ),
        table(summary, headers=shown_columns(summary)),
    ]
    stops = [
        {"law": name, "run": index, "reason": reason}
        for name, record in result.records.items()
        for index, reason in enumerate(record.stopped)
        if reason is not None
    ]
    if stops:
        parts += [paragraph("Stopped runs:"), table(pd.DataFrame(stops))]
    return [
        *parts,
        details("Per coordinate (coordinates.csv)", table(result.coordinates)),
    ]
