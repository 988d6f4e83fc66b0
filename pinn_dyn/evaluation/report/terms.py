"""Learned against true terms as interactive heat maps, side by side."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

import numpy as np
import plotly.graph_objects as go
import torch
from plotly.subplots import make_subplots
from torch import Tensor

from pinn_dyn.evaluation.learned_terms import TermComparison
from pinn_dyn.evaluation.report.style import DARK

_TERMS = {"M": "M(q)", "M_inverse": "M⁻¹(q)", "D": "D(q)", "G": "G(q)", "A": "A(q)"}
_COLUMNS = ("true X", "learned X<sub>L</sub>", "P X, best P")
_COLOURS = "RdBu_r"
_ROW = 165  # height of a term, px


def terms_figure(comparisons: Mapping[str, TermComparison]) -> go.Figure:
    """Every term X beside the learned X_L and the best P X; a menu chooses model and configuration.

    The three of a row share one colour scale, from minus to plus their largest entry; the colour
    follows the square root of an entry, so that small ones are not lost.

    Args:
        comparisons: names of models, and their terms at one or more configurations each.
    """
    frames = {
        f"{model}, {name}": _heat_maps(comparison, index)
        for model, comparison in comparisons.items()
        for index, name in enumerate(comparison.names)
    }
    drawn = make_subplots(
        rows=len(_TERMS),
        cols=3,
        column_titles=list(_COLUMNS),
        vertical_spacing=0.03,
        horizontal_spacing=0.03,
    )
    names = list(frames)
    size = next(iter(comparisons.values())).q.shape[-1]
    widest = max(maps["z"].shape[1] for maps in frames[names[0]])
    for k, maps in enumerate(frames[names[0]]):
        row, column = divmod(k, 3)
        drawn.add_heatmap(
            **maps,
            row=row + 1,
            col=column + 1,
            zmin=-1.6,  # the ends of the colour scale are too dark to read a number on
            zmax=1.6,
            colorscale=_COLOURS,
            showscale=False,
            texttemplate="%{text}",
            textfont={"size": 12 if size <= 3 else 9, "color": DARK},
            hovertemplate="row %{y}, column %{x}: %{customdata:.6g}<extra></extra>",
            xgap=2,
            ygap=2,
        )
        # The cells of a narrow matrix are as wide as those of the widest.
        middle = (maps["z"].shape[1] + 1) / 2
        drawn.update_xaxes(
            range=[middle - widest / 2, middle + widest / 2], row=row + 1, col=column + 1
        )
        if column == 0:
            title = {"text": list(_TERMS.values())[row], "font": {"size": 14}}
            drawn.update_yaxes(title=title, row=row + 1, col=1)
    drawn.update_xaxes(visible=False)
    drawn.update_yaxes(
        showticklabels=False, showgrid=False, zeroline=False, range=[size + 0.5, 0.5]
    )
    drawn.frames = [
        go.Frame(name=str(k), data=[go.Heatmap(**maps) for maps in frames[name]])
        for k, name in enumerate(names)
    ]
    height = _ROW * len(_TERMS) + 100
    drawn.update_layout(
        template="plotly_white",
        height=height,
        margin={"l": 50, "r": 10, "t": 90, "b": 10},
        font={"family": "system-ui, sans-serif", "size": 12, "color": DARK},
        updatemenus=[
            {
                "buttons": [
                    {
                        "label": html.escape(name),
                        "method": "animate",
                        "args": [
                            [str(k)],
                            {
                                "mode": "immediate",
                                "frame": {"duration": 0, "redraw": True},
                                "transition": {"duration": 0},
                            },
                        ],
                    }
                    for k, name in enumerate(names)
                ],
                "x": 0,
                "xanchor": "left",
                "y": 1 + 85 / (height - 100),
                "yanchor": "top",
            }
        ],
    )
    return drawn


def _heat_maps(comparison: TermComparison, index: int) -> list[dict[str, Any]]:
    """The maps of all terms at one configuration, row by row."""
    maps = []
    matrices = comparison.matrices()
    for term in _TERMS:
        three = [matrix[index] for matrix in matrices[term]]
        scale = max(_largest(matrix) for matrix in three) or 1.0
        for matrix in three:
            rows, columns = matrix.shape
            maps.append(
                {
                    "z": (matrix.sign() * (matrix.abs() / scale).sqrt()).clamp(-1, 1).numpy(),
                    "x": np.arange(1, columns + 1),
                    "y": np.arange(1, rows + 1),
                    "text": _texts(matrix, 3 if rows <= 3 else 2),
                    "customdata": matrix.numpy(),
                }
            )
    return maps


def _largest(matrix: Tensor) -> float:
    """Size of the largest finite entry."""
    return float(torch.where(matrix.isfinite(), matrix.abs(), 0.0).max())


def _texts(matrix: Tensor, digits: int) -> list[list[str]]:
    floor = 1e-6 * float(matrix.abs().max())
    return [
        ["0" if abs(value) <= floor else f"{value:.{digits}g}" for value in row]
        for row in matrix.tolist()
    ]
