"""The interactive figure of errors over time."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
import torch
from torch import Tensor

from pinn_dyn.evaluation.report.style import CURVE, POINTS, calm, colour, dash, simplify

_HEIGHT, _ABOVE, _BELOW = 500, 80, 90  # of the figure and its margins, px
_TOLERANCE = 0.004  # decades, less than a pixel


def error_figure(
    curves: Mapping[str, tuple[Tensor, Tensor, Tensor]], *, label: str, one: str, lost: str
) -> go.Figure:
    """Error over time: the mean over trajectories and their 10-90 % band, or every trajectory.

    Those that were lost are left out and counted in the legend. The start is not drawn: its error
    may be 0, which a logarithmic axis has not.

    Args:
        curves: names, and of each the times ``(T,)``, the errors ``(K, T)`` and which of the K
            trajectories were lost, ``(K,)``.
        label: name and unit of the error.
        one: what a trajectory is called.
        lost: what happened to those, as "diverged".
    """
    drawn = go.Figure()
    means: list[bool] = []  # which traces each of the two buttons shows
    singles: list[bool] = []
    floors: list[float] = []
    tops: list[float] = []
    for index, (name, (t, error, gone)) in enumerate(curves.items()):
        count = int(gone.sum())
        note = f" ({count} of {len(gone)} {lost})" if count else ""
        style: dict[str, Any] = {
            "name": html.escape(name) + note,
            "legendgroup": f"{index}",
            "mode": "lines",
        }
        line = {"color": colour(index), "dash": dash(index)}
        if count == len(gone):  # in the legend only
            drawn.add_scatter(x=[None], y=[None], line=line, **style)
            means.append(True)
            singles.append(True)
            continue
        t, kept = t[1:], error[~gone][:, 1:].double()
        mean = kept.mean(dim=0)
        low, high = torch.quantile(kept, torch.tensor([0.1, 0.9], dtype=kept.dtype), dim=0)
        for edge, fill in ((low, None), (high, "tonexty")):
            x, y = simplify(t, edge, tolerance=_TOLERANCE, log=True)
            drawn.add_scatter(
                x=x,
                y=y,
                fill=fill,
                fillcolor=_faint(colour(index)),
                line={"width": 0, "color": colour(index)},
                showlegend=False,
                hoverinfo="skip",
                **style,
            )
        x, y = simplify(t, mean, tolerance=_TOLERANCE, log=True)
        hover = "%{y:.3g} at %{x:.3g} s"
        drawn.add_scatter(x=x, y=y, line=line | {"width": 2}, hovertemplate=hover, **style)
        x, y, which = _joined(t, kept, (~gone).nonzero()[:, 0].tolist(), len(curves))
        drawn.add_scatter(
            x=x,
            y=y,
            customdata=which,
            line=line | {"width": 1},
            visible=False,
            hovertemplate="%{customdata}: " + hover,
            **style,
        )
        means += [True, True, True, False]
        singles += [False, False, False, True]
        floors.append(float(mean.median()))
        tops.append(float(kept.max()))
    # The error starts from nothing: three decades below the best are enough of that.
    ends = None
    if floors and min(floors) > 0:
        ends = [np.log10(1e-3 * min(floors)), np.log10(2 * max(tops))]
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
    drawn.update_yaxes(type="log", range=ends, title=html.escape(label))
    return drawn


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
