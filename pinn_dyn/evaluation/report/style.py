"""What all figures of a report share: colours, line styles, fonts, and curves of few points."""

from __future__ import annotations

import itertools

import numpy as np
import plotly.graph_objects as go
from torch import Tensor

from pinn_dyn.evaluation.drawing import DARK

POINTS = 110_000
"""Points of all curves of a figure, about 1.2 MB, at most."""

CURVE = 500
"""Points of one curve, at most."""

_GRID = "#e6eaee"


def calm(drawn: go.Figure) -> go.Figure:
    """The style that all figures share."""
    drawn.update_layout(
        template="plotly_white",
        font={"family": "system-ui, sans-serif", "size": 12, "color": DARK},
        margin={"l": 70, "r": 15},
        legend={"orientation": "h", "x": 0, "yanchor": "top"},
        hoverlabel={"namelength": -1},
    )
    axes = {
        "gridcolor": _GRID,
        "zeroline": False,
        "exponentformat": "power",
        "minorloglabels": "none",
    }
    return drawn.update_xaxes(axes).update_yaxes(axes)


def simplify(
    t: Tensor, y: Tensor, *, tolerance: float, points: int = CURVE, log: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """A curve by few of its points: linear between them, it is nowhere off by more than allowed.

    The algorithm of Douglas and Peucker: of every segment the farthest point is added, until all
    are within the tolerance. Peaks stay, and so do gaps (NaN).

    Args:
        t: times, ``(T,)``.
        y: values, ``(T,)``.
        tolerance: distance of y that cannot be seen; of log10 y on a logarithmic axis.
        points: where to stop, about, although some are farther off.
        log: whether the axis is logarithmic; what is not positive becomes a gap.
    """
    times, values = t.double().numpy(), y.double().numpy()
    # A page holds single precision: what has diverged beyond it is a gap.
    drawable = (np.abs(values) < np.finfo(np.float32).max) & ((values > 0) | (not log))
    values = np.where(drawable, values, np.nan)
    heights = np.log10(values) if log else values
    # The ends, and both sides of where a gap begins or stops.
    edges = np.flatnonzero(drawable[1:] != drawable[:-1])
    kept = np.unique(np.concatenate([[0, len(values) - 1], edges, edges + 1]))
    while len(kept) < points:
        off = np.nan_to_num(np.abs(heights - np.interp(times, times[kept], heights[kept])))
        farthest = [a + int(off[a:b].argmax()) for a, b in itertools.pairwise(kept)]
        added = [k for k in farthest if off[k] > tolerance]
        if not added:
            break
        kept = np.union1d(kept, added)
    return times[kept].astype(np.float32), values[kept].astype(np.float32)
