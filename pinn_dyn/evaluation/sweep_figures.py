"""Figures of sweeps: what a parameter does to the error."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pinn_dyn.evaluation.drawing import COLOURS

_MARKERS = ("o", "s")  # each with all colours
_DECADE = 10.0
_LABELLED = 8  # values on a logarithmic axis that have room for a label each


def sweep_figure(runs: pd.DataFrame, *, x: str, lines: list[str], y: str) -> Figure:
    """A metric against one parameter: a dot for each run, a line through the means over seeds.

    An axis is logarithmic where its values span a decade or more. Infinite figures (diverged
    runs) cannot be drawn; a note says how many there are.

    Args:
        runs: one row per run, as ``runs_table`` returns it.
        x: parameter along the horizontal axis; words are drawn as categories.
        lines: the other parameters; each combination of theirs is a line.
        y: the metric.

    Raises:
        ValueError: if x or y is no column, no figure is finite, or there are more lines than can
            be told apart.
    """
    for argument, name in (("the horizontal axis", x), ("the vertical axis", y)):
        if name not in runs:
            raise ValueError(
                f"{argument} is '{name}', expected a column of the table, which has what varies: "
                f"{', '.join(runs.columns)}"
            )
    known = runs[runs[x].notna() & runs[y].notna()]
    finite = known[np.isfinite(known[y].astype(float))]
    if finite.empty:
        raise ValueError(f"no run has both '{x}' and a finite '{y}': nothing to draw")
    groups = [("", finite)]
    if lines:
        groups = [
            (_line_name(lines, key), rows)
            for key, rows in finite.groupby(lines, sort=False, dropna=False)
        ]
    styles = [(colour, marker) for marker in _MARKERS for colour in COLOURS]
    if len(groups) > len(styles):
        raise ValueError(
            f"{len(groups)} lines, one for each combination of {', '.join(lines)}, cannot be told "
            f"apart: choose some with filter, for at most {len(styles)}"
        )
    numeric = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in finite[x])
    places = finite[x].astype(float if numeric else str)
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    ax = figure.subplots()
    if not numeric:
        ax.xaxis.update_units(sorted(set(places)))  # words side by side
    for (label, rows), (colour, marker) in zip(groups, styles[: len(groups)], strict=True):
        at = places[rows.index]
        means = rows[y].astype(float).groupby(at).mean()
        ax.plot(means.index, means, color=colour, marker=marker, label=label)
        if len(rows) > len(means):
            ax.plot(at, rows[y], marker, color=colour, alpha=0.4, markersize=4, linestyle="none")
    if numeric:
        texts = {float(value): str(value) for value in finite[x]}
        logarithmic = _spans_decades([*texts])
        if logarithmic:
            ax.set_xscale("log")
        if len(texts) <= _LABELLED and (logarithmic or _apart([*texts])):
            # The values themselves, not powers of ten or numbers between them.
            ax.set_xticks([*texts], texts.values())
            ax.minorticks_off()
    if _spans_decades(finite[y].tolist()):
        ax.set_yscale("log")
    _label(ax, x, y, lost=len(known) - len(finite))
    if lines:
        title = lines[0] if len(lines) == 1 else None
        columns = 2 if len(groups) > 4 else 4
        figure.legend(loc="outside lower center", ncols=columns, title=title)
    return figure


def _line_name(lines: list[str], key: tuple[object, ...]) -> str:
    """What a line stands for; of a single parameter the value, as the legend bears its name."""
    if len(lines) == 1:
        return "-" if pd.isna(key[0]) else str(key[0])
    return ", ".join(f"{n}={v}" for n, v in zip(lines, key, strict=True) if not pd.isna(v))


def _spans_decades(values: list[float]) -> bool:
    low, high = min(values), max(values)
    return low > 0 and math.isfinite(high) and high >= _DECADE * low


def _apart(values: list[float]) -> bool:
    """Whether there is room for a label at each value of a linear axis."""
    gaps = np.diff(sorted(values))
    return bool((gaps > 0.1 * gaps.sum()).all())


def _label(ax: Axes, x: str, y: str, *, lost: int) -> None:
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.grid(True, which="major", alpha=0.3)
    notes = ["small dots: seeds, line: their mean"]
    if lost:
        notes.append(f"{lost} diverged {'run is' if lost == 1 else 'runs are'} not drawn")
    ax.set_title("; ".join(notes), loc="right", fontsize="small")
