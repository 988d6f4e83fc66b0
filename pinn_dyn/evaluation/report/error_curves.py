"""The interactive figure of errors over time."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from torch import Tensor

from pinn_dyn.evaluation.drawing import Panel
from pinn_dyn.evaluation.report.page import Section, figure, paragraph
from pinn_dyn.evaluation.report.style import CURVE, POINTS, calm, simplify

_HEIGHT, _ABOVE, _BELOW = 500, 80, 90  # of the figure and its margins, px
_TOLERANCE = 0.004  # decades, less than a pixel


def error_figure(panel: Panel, *, one: str, lost: str) -> go.Figure:
    """Error over time: the mean over trajectories and their 10-90 % band, or every trajectory.

    Those that were lost are left out and counted in the legend.

    Args:
        panel: the errors, as :func:`pinn_dyn.evaluation.drawing.error_panel` makes it.
        one: what a trajectory is called.
        lost: what happened to those that were lost, as "diverged".
    """
    drawn = go.Figure()
    means: list[bool] = []  # which traces each of the two buttons shows
    singles: list[bool] = []

    def add(x: Any, y: Any, shown: tuple[bool, bool], **settings: Any) -> None:
        drawn.add_scatter(x=x, y=y, mode="lines", visible=shown[0], **settings)
        means.append(shown[0])
        singles.append(shown[1])

    for index, line in enumerate(panel.lines):
        style = {"name": html.escape(line.legend(lost)), "legendgroup": f"{index}"}
        look = {"color": line.colour, "dash": line.dash}
        found = line.statistics()
        if found is None:  # in the legend only
            add([None], [None], (True, True), line=look, **style)
            continue
        mean, low, high = found
        for edge, fill in ((low, None), (high, "tonexty")) if line.band else ():
            edges = {"width": 0, "color": line.colour}
            add(
                *simplify(line.t, edge, tolerance=_TOLERANCE, log=True),
                (True, False),
                fill=fill,
                fillcolor=_faint(line.colour),
                line=edges,
                showlegend=False,
                hoverinfo="skip",
                **style,
            )
        hover = "%{y:.3g} at %{x:.3g} s"
        x, y = simplify(line.t, mean, tolerance=_TOLERANCE, log=True)
        # A floor is its mean under both buttons.
        both = (True, not line.band)
        add(x, y, both, line=look | {"width": line.width}, hovertemplate=hover, **style)
        if line.band:
            numbers = range(len(line.y)) if line.lost is None else (~line.lost).nonzero()[:, 0]
            x, y, which = _joined(line.t, line.kept(), [int(k) for k in numbers], len(panel.lines))
            add(
                x,
                y,
                (False, True),
                customdata=which,
                line=look | {"width": 1},
                hovertemplate="%{customdata}: " + hover,
                **style,
            )
    limits = panel.limits_of_means()
    ends = None if limits is None else [np.log10(limit) for limit in limits]
    shown = [("mean, 10–90 %", means), (f"every {one}", singles)]
    scales = [
        ("log", {"yaxis.type": "log", "yaxis.range": ends}),
        ("linear", {"yaxis.type": "linear", "yaxis.autorange": True}),
    ]
    calm(drawn).update_layout(
        height=_HEIGHT,
        margin={"t": _ABOVE, "b": _BELOW},
        legend={"y": -0.18},
        updatemenus=[
            _buttons(5, "restyle", [(text, {"visible": visible}) for text, visible in shown]),
            _buttons(40, "relayout", scales),
        ],
    )
    drawn.update_xaxes(title="time [s]")
    drawn.update_yaxes(type="log", range=ends, title=html.escape(panel.label))
    return drawn


def error_section(panel: Panel, *, one: str, lost: str) -> Section:
    """The section of a page with :func:`error_figure`."""
    text = "A click on a name of the legend hides or shows it, a double click leaves it alone."
    drawn = figure(error_figure(panel, one=one, lost=lost), "figure-error")
    return Section("Error over time", [drawn, paragraph(text)])


def _buttons(above: float, method: str, entries: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """A row of buttons this far above the plot, px."""
    return {
        "type": "buttons",
        "direction": "right",
        "x": 0,
        "xanchor": "left",
        "y": 1 + above / (_HEIGHT - _ABOVE - _BELOW),
        "yanchor": "bottom",
        "pad": {"t": 0, "b": 0, "l": 0},
        "buttons": [{"label": text, "method": method, "args": [args]} for text, args in entries],
    }


def _joined(
    t: Tensor, error: Tensor, numbers: Sequence[int], names: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Many curves as one with gaps: times, values, and the number of the curve at each."""
    points = min(CURVE, POINTS // (len(numbers) * names))
    pieces = [simplify(t, row, tolerance=_TOLERANCE, points=points, log=True) for row in error]
    gap = np.full(1, np.nan, dtype=np.float32)
    x = np.concatenate([part for times, _ in pieces for part in (times, gap)])
    y = np.concatenate([part for _, values in pieces for part in (values, gap)])
    counts = [len(times) + 1 for times, _ in pieces]
    return x, y, np.repeat(np.array(numbers, dtype=np.int32), counts)


def _faint(shade: str) -> str:
    red, green, blue = (int(shade[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.18)"
