"""The interactive figure of one motion at a time, of many that a slider chooses from."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
import torch
from plotly.subplots import make_subplots
from torch import Tensor

from pinn_dyn.evaluation.drawing import Line, Panel
from pinn_dyn.evaluation.report.style import CURVE, POINTS, calm, simplify

_SHOWN = 24  # motions to choose from, at most
_PANEL = 135  # height of a panel, px
_MENU, _SLIDER, _NOTHING = 60, 110, 20  # room above the panels, px
_BELOW = 90  # room for the legend, px
_TOLERANCE = 1e-3  # of the height of a panel, less than a pixel
_FAR = 100  # a line is not drawn further from its panel than this many times its height


def motion_figure(
    panels: Sequence[Panel],
    names: Mapping[int, str],
    *,
    first: int,
    what: str,
    everyone: str,
) -> go.Figure:
    """Panels under each other, of one motion at a time: a slider chooses it, a menu the lines.

    Args:
        panels: what is drawn, of K motions each.
        names: which of the K motions to choose from, and their names on the slider.
        first: the motion that is shown at first.
        what: what a motion is called, as "trajectory".
        everyone: the entry of the menu that shows all lines, as "all models".
    """
    lines = [(row, line) for row, panel in enumerate(panels) for line in panel.lines]
    drawn = make_subplots(rows=len(panels), shared_xaxes=True, vertical_spacing=0.22 / len(panels))
    points = min(CURVE, POINTS // (len(lines) * len(names)))
    frames = {
        index: (
            _motion(panels, index, points),
            {_axis("yaxis", row): _range(panel, index) for row, panel in enumerate(panels)},
        )
        for index in names
    }
    legend: set[str] = set()
    for (row, line), data in zip(lines, frames[first][0], strict=True):
        drawn.add_trace(
            go.Scatter(
                **data,
                name=html.escape(line.name),
                legendgroup=line.name,
                showlegend=line.name not in legend,
                mode="lines",
                connectgaps=False,
                line={"color": line.colour, "dash": line.dash, "width": line.width},
                hovertemplate="%{y:.4g}",
            ),
            row=row + 1,
            col=1,
        )
        legend.add(line.name)
    drawn.frames = [
        go.Frame(name=str(index), data=data, layout=ranges)
        for index, (data, ranges) in frames.items()
    ]
    plot = _PANEL * len(panels)
    choices = _choices([line for _, line in lines], everyone)
    above = (_MENU if choices else 0) + (_SLIDER if len(names) > 1 else 0) or _NOTHING
    height = plot + above + _BELOW
    drawn.update_layout(
        frames[first][1],
        height=height,
        hovermode="x unified",
        sliders=[
            {
                "active": list(names).index(first),
                "currentvalue": {"prefix": f"{what} ", "font": {"size": 14}},
                "ticklen": 4,
                "minorticklen": 0,
                "font": {"size": 11},
                "x": 0,
                "len": 1,
                "y": 1 + 75 / plot,
                "yanchor": "middle",
                "pad": {"t": 0, "b": 0},
                "steps": [
                    {
                        "label": html.escape(name),
                        "method": "animate",
                        "args": [
                            [str(index)],
                            {
                                "mode": "immediate",
                                "frame": {"duration": 0, "redraw": True},
                                "transition": {"duration": 0},
                            },
                        ],
                    }
                    for index, name in names.items()
                ],
            }
        ],
    )
    if choices:
        drawn.update_layout(
            updatemenus=[
                {
                    "buttons": choices,
                    "x": 0,
                    "xanchor": "left",
                    "y": 1 + (above - 5) / plot,
                    "yanchor": "top",
                    "pad": {"t": 0},
                }
            ]
        )
    for row, panel in enumerate(panels):
        drawn.update_yaxes(
            title={"text": html.escape(panel.label), "font": {"size": 12}},
            type="log" if panel.log else "linear",
            nticks=5,
            row=row + 1,
            col=1,
        )
    drawn.update_xaxes(unifiedhovertitle={"text": "%{x:.4g} s"})
    drawn.update_xaxes(title="time [s]", row=len(panels), col=1)
    margin = {"t": above, "b": _BELOW}
    return calm(drawn).update_layout(margin=margin, legend={"y": -45 / plot})


def shown_motions(count: int, wanted: Sequence[int]) -> list[int]:
    """Which of ``count`` motions a figure offers: the wanted ones and the first, up to 24."""
    order = dict.fromkeys([*wanted, *range(count)])
    return sorted(list(order)[: max(_SHOWN, len(set(wanted)))])


def _motion(panels: Sequence[Panel], index: int, points: int) -> list[dict[str, np.ndarray]]:
    """The curves of one motion."""
    curves = []
    for panel in panels:
        low, high = panel.limits(index)
        height = np.log10(high / low) if panel.log else high - low
        for line in panel.lines:
            t, y = line.t.double(), line.y[index].double()
            if line.held:
                t, y = _stairs(t, y)
            if not panel.log:
                far = (y - (low + high) / 2).abs() > _FAR * height
                y = torch.where(far, torch.nan, y)
            x, values = simplify(t, y, tolerance=_TOLERANCE * height, points=points, log=panel.log)
            curves.append({"x": x, "y": values})
    return curves


def _stairs(t: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """A held input as corners, with a rise so short that it looks upright."""
    corners = t.repeat_interleave(2)[1:]
    corners[::2][1:] += 1e-6 * t.diff()
    return corners, y.repeat_interleave(2)[:-1]


def _range(panel: Panel, index: int) -> dict[str, Any]:
    low, high = panel.limits(index)
    return {"range": [np.log10(low), np.log10(high)] if panel.log else [low, high]}


def _choices(lines: Sequence[Line], everyone: str) -> list[dict[str, Any]]:
    """Entries of a menu: all lines, or one name beside those that are always there."""
    names = list(dict.fromkeys(line.name for line in lines if not line.always))
    if len(names) < 2:
        return []
    shown = [(everyone, [True] * len(lines))]
    shown += [(name, [line.always or line.name == name for line in lines]) for name in names]
    return [
        {"label": html.escape(name), "method": "restyle", "args": [{"visible": visible}]}
        for name, visible in shown
    ]


def _axis(name: str, row: int) -> str:
    return name if row == 0 else f"{name}{row + 1}"
