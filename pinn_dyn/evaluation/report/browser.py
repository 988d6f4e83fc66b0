"""The interactive figure of a prediction page: a browser of trajectories and their errors."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots
from torch import Tensor

from pinn_dyn.evaluation.figures import ERROR
from pinn_dyn.evaluation.plots import (
    DARK,
    TRUTH,
    baseline_style,
    limits,
    log_limits,
    model_style,
    with_unit,
)
from pinn_dyn.evaluation.prediction import Prediction
from pinn_dyn.mechanics import Trajectory

MAX_TRAJECTORIES = 24
"""Number of trajectories that the browser offers."""

_POINTS = 400  # of one curve
_PANEL, _ABOVE, _BELOW = 140, 110, 90  # heights of a panel and of the margins, px
_DASHES = {"-": "solid", "--": "dash", ":": "dot", "-.": "dashdot"}


def trajectory_browser(
    truth: Trajectory,
    predictions: Mapping[str, Prediction],
    baselines: Mapping[str, Prediction],
    *,
    labels: Sequence[str],
    input_labels: Sequence[str],
    trajectories: Sequence[int],
) -> go.Figure:
    """Return a figure of one trajectory at a time: configuration, error and input over time.

    A slider selects one of the ``trajectories``. The truth, K trajectories stacked, sets the range.
    """
    rollouts = {**predictions, **baselines}
    styles = {}
    for k, name in enumerate(rollouts):
        style = model_style(k) if name in predictions else baseline_style(1)
        dash = _DASHES[style["linestyle"]]
        styles[name] = {"color": style["color"], "dash": dash, "width": style.get("linewidth", 1.5)}
    size = len(labels)
    real = {"color": TRUTH, "width": 4}
    shape = "hv" if truth.input.interpolation == "hold" else "linear"
    driven = {"color": DARK, "width": 1.2, "shape": shape}
    curves: list[tuple[int, str, dict[str, Any], Tensor, Tensor]] = []  # row, name, line, t, values
    for k in range(size):
        curves.append((k, "truth", real, truth.t, truth.q[..., k]))
        curves += [(k, name, styles[name], x.t, x.q_hat[..., k]) for name, x in rollouts.items()]
    curves += [(size, name, styles[name], x.t, x.error()) for name, x in rollouts.items()]
    for k in range(len(input_labels)):
        curves.append((size + 1 + k, "input", driven, truth.t, truth.u[..., k]))

    titles = [*labels, with_unit(ERROR, labels), *input_labels]
    drawn = make_subplots(len(titles), 1, shared_xaxes=True, vertical_spacing=0.2 / len(titles))
    first, names = trajectories[0], set()
    for row, name, line, t, _ in curves:
        drawn.add_scatter(
            x=_thinned(t),
            name=html.escape(name),
            legendgroup=name,
            showlegend=name not in names,
            mode="lines",
            line=line,
            hovertemplate="%{y:.4g}",
            row=row + 1,
            col=1,
        )
        names.add(name)
    frames = {}
    for k in sorted(trajectories):
        ends = [limits(truth.q[k, :, row]) for row in range(size)]
        errors = log_limits([item.error()[k] for item in rollouts.values()])
        ends.append((math.log10(errors[0]), math.log10(errors[1])))
        ranges = {f"yaxis{row + 1}": {"range": pair} for row, pair in enumerate(ends)}
        data = [{"y": _thinned(values[k])} for *_, values in curves]
        frames[k] = go.Frame(name=str(k), data=data, layout=ranges)
    drawn.frames = list(frames.values())
    for trace, start in zip(drawn.data, frames[first].data, strict=True):
        trace.y = start.y
    for row, title in enumerate(titles):
        text = {"text": html.escape(title), "font": {"size": 12}}
        drawn.update_yaxes(title=text, nticks=5, row=row + 1, col=1)
    drawn.update_yaxes(type="log", exponentformat="power", row=size + 1, col=1)
    drawn.update_xaxes(title="time [s]", row=len(titles), col=1)
    plot = _PANEL * len(titles)
    jump = {"frame": {"duration": 0, "redraw": True}}
    steps = [{"label": str(k), "method": "animate", "args": [[str(k)], jump]} for k in frames]
    slider = {
        "active": list(frames).index(first),
        "currentvalue": {"prefix": "trajectory ", "font": {"size": 14}},
        "pad": {"t": 0, "b": 0},
        "y": 1 + 75 / plot,
        "yanchor": "middle",
        "steps": steps,
    }
    drawn.update_layout(
        frames[first].layout,
        template="plotly_white",
        height=plot + _ABOVE + _BELOW,
        margin={"t": _ABOVE, "b": _BELOW, "l": 70, "r": 15},
        font={"family": "system-ui, sans-serif", "size": 12, "color": DARK},
        legend={"orientation": "h", "x": 0, "y": -45 / plot, "yanchor": "top"},
        hovermode="x unified",
        hoverlabel={"namelength": -1},
        sliders=[slider] if len(frames) > 1 else [],
    )
    return drawn


def _thinned(values: Tensor) -> np.ndarray:
    samples = values.detach()[:: -(-len(values) // _POINTS)].double().numpy()
    return np.where(np.abs(samples) < 1e6, samples, np.nan).astype(np.float32)
