"""The drawings as PNG, by matplotlib, without a display or global state."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from pinn_dyn.data.whole import whole
from pinn_dyn.evaluation.drawing import Line, Panel

DASHES = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-."}


def motion_png(
    columns: Sequence[Sequence[Panel]], motion: int, *, title: str, end: float | None = None
) -> Figure:
    """One motion: panels under each other, in one or more columns that share their time.

    A line is not drawn far outside its panel; a note above says when it leaves.

    Args:
        columns: panels of each column.
        motion: which of the K motions.
        title: what is drawn.
        end: time of an early end, marked in all panels, s.
    """
    rows = max(map(len, columns))
    size = (5.8 * len(columns), 1.55 * rows + 1.3)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, len(columns), sharex="col", squeeze=False)
    t = columns[0][0].lines[0].t
    for column, panels in enumerate(columns):
        for row in range(rows):
            ax = axes[row, column]
            if row >= len(panels):
                ax.set_axis_off()
                continue
            _draw(ax, panels[row], motion)
            if end is not None:
                ax.axvline(end, color="black", linestyle="--", linewidth=1.2)
            if row == len(panels) - 1:
                ax.set_xlabel("time [s]")
                ax.tick_params(labelbottom=True)
        axes[0, column].set_xlim(float(t[0]), float(t[-1]))
        figure.align_ylabels(axes[:, column])
    _legend(figure)
    figure.suptitle(title, fontsize="medium" if "\n" in title else None)
    return figure


def mean_png(panel: Panel, *, title: str, note: str, lost: str) -> Figure:
    """Means over the kept curves of each line and their 10-90 % bands, over time.

    Args:
        panel: one panel.
        title: data set and horizon.
        note: what the means are over, above the names.
        lost: what happened to curves that are in no mean, as "diverged".
    """
    figure = Figure(figsize=(8, 4.8), layout="constrained")
    ax = figure.subplots()
    for line in panel.lines:
        style = _style(line) | {"label": line.legend(lost)}
        found = line.statistics()
        if found is None:
            ax.plot([], [], **style)
            continue
        mean, low, high = found
        ax.plot(line.t, mean, **style)
        if line.band:
            ax.fill_between(line.t, low, high, color=line.colour, alpha=0.18, linewidth=0)
    if panel.log:
        ax.set_yscale("log")
        if ends := panel.limits_of_means():
            ax.set_ylim(bottom=ends[0])
    ax.set_xlabel("time [s]")
    ax.set_ylabel(panel.label)
    ax.grid(True, which="major", alpha=0.3)
    ax.set_xlim(0, max(float(line.t[-1]) for line in panel.lines))
    figure.legend(
        loc="outside lower center", ncols=min(len(panel.lines), 5), title=note, fontsize="small"
    )
    figure.suptitle(title)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG at 150 dpi, and its folder if there is none."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as partial:
        figure.savefig(partial, format="png", dpi=150)


def _style(line: Line) -> dict[str, Any]:
    if line.dots:
        return {"color": line.colour, "linestyle": "none", "marker": ".", "markersize": 3}
    return {"color": line.colour, "linestyle": DASHES[line.dash], "linewidth": line.width}


def _draw(ax: Axes, panel: Panel, motion: int) -> None:
    low, high = panel.limits(motion)
    notes = []
    for line in panel.lines:
        y = line.y[motion].double()
        lost = ~torch.isfinite(y)
        outside = ((y < low) | (y > high)) & ~lost
        if not panel.log:  # only the way out matters; huge numbers upset the renderer
            y = y.clamp(2 * low - high, 2 * high - low)
        (drawn,) = ax.plot(line.t, y, label=line.name, **_style(line))
        drawn.set_drawstyle("steps-post" if line.held else "default")
        if outside.any() and not panel.log:
            notes.append(f"{line.name} leaves the panel at {_first(line, outside)} s")
        elif lost.any() and panel.leading:
            notes.append(f"{line.name} broke down at {_first(line, lost)} s")
    if panel.log:
        ax.set_yscale("log")
    ax.set_ylim(low, high)
    ax.set_ylabel(panel.label)
    ax.grid(True, which="major", alpha=0.3)
    # Above the panel, where no line can hide it.
    ax.set_title("\n".join(notes), loc="right", fontsize="small")


def _first(line: Line, where: Tensor) -> str:
    return f"{float(line.t[int(where.int().argmax())]):.3g}"


def _legend(figure: Figure) -> None:
    """Every name once, below the panels."""
    found: dict[str, Any] = {}
    for ax in figure.axes:
        handles, names = ax.get_legend_handles_labels()
        found |= {n: h for n, h in zip(names, handles, strict=True) if n not in found}
    handles, names = list(found.values()), list(found)
    figure.legend(handles, names, loc="outside lower center", ncols=min(len(names), 4))
