"""Plotting basics that all figures share: colors, labels, panels over time, PNG files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from torch import Tensor

from pinn_dyn.data.whole import whole

# The palette of Okabe and Ito, which color-blind readers can tell apart.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
TRUTH, BASELINE, DARK = "#b3b3b3", "#9aa5ae", "#24303c"
_LINE_STYLES = ("-", "--", ":", "-.")


class Errors(NamedTuple):
    """Errors of K trajectories over time.

    Attributes:
        t: times, ``(T,)``, s.
        error: errors, ``(K, T)``.
        excluded: trajectories that diverged or were stopped, ``(K,)``, bool. No mean has them.
    """

    t: Tensor
    error: Tensor
    excluded: Tensor


def model_style(index: int) -> dict[str, Any]:
    """Return the line style of the model or control law with this index, the same in all figures.

    The first six differ by color, the next six also by dashes.
    """
    dashes = _LINE_STYLES[index // len(COLORS) % len(_LINE_STYLES)]
    return {"color": COLORS[index % len(COLORS)], "linestyle": dashes}


def baseline_style(index: int) -> dict[str, Any]:
    """Return the line style of a baseline: thin and grey."""
    dashes = _LINE_STYLES[index % len(_LINE_STYLES)]
    return {"color": BASELINE, "linestyle": dashes, "linewidth": 1.0}


def default_labels(labels: Sequence[str] | None, letter: str, count: int) -> list[str]:
    """Return the labels, or q1 ... qN without any.

    Raises:
        ValueError: if there are more or fewer than ``count``.
    """
    names = list(labels) if labels else [f"{letter}{k + 1}" for k in range(count)]
    if len(names) != count:
        raise ValueError(f"{len(names)} labels for {letter}, expected {count}: {names}")
    return names


def units(labels: Sequence[str]) -> str:
    """Return the units of labels such as ``Δx [rad]`` or ``q1 (rad)``, without repetition."""
    matches = [re.search(r"[\[(]([^\[\]()]+)[\])]\s*$", label) for label in labels]
    return ", ".join(dict.fromkeys(match[1] for match in matches if match))


def with_unit(text: str, labels: Sequence[str]) -> str:
    """Append the units of the labels to a text."""
    unit = units(labels)
    return f"{text} [{unit}]" if unit else text


def panels(
    columns: Sequence[Sequence[str]], t: Tensor | np.ndarray, *, title: str
) -> tuple[Figure, list[list[Axes]]]:
    """Create columns of panels over time.

    Args:
        columns: label of the vertical axis of each panel, for each column.
        t: times, ``(T,)``, s.
        title: title of the figure.

    Returns:
        The figure, and the axes of each column.
    """
    rows = max(map(len, columns))
    size = (5.8 * len(columns), 1.55 * rows + 1.3)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, len(columns), sharex=True, squeeze=False)
    for column, labels in zip(grid.T, columns, strict=True):
        for ax, label in zip(column, labels, strict=False):
            ax.set_ylabel(label)
            ax.grid(True, alpha=0.3)
        for ax in column[len(labels) :]:
            ax.set_axis_off()
        last = column[len(labels) - 1]
        last.set_xlabel("time [s]")
        last.tick_params(labelbottom=True)
        figure.align_ylabels(column)
    grid[0, 0].set_xlim(float(t[0]), float(t[-1]))
    figure.suptitle(title, fontsize="medium")
    axes = [list(column[: len(labels)]) for column, labels in zip(grid.T, columns, strict=True)]
    return figure, axes


def legend_below(figure: Figure, columns: int = 4, **settings: Any) -> None:
    """Add one legend below all panels, with each name once."""
    entries: dict[str, Any] = {}
    for ax in figure.axes:
        handles, names = ax.get_legend_handles_labels()
        entries |= dict(zip(names, handles, strict=True))
    columns = min(len(entries), columns)
    figure.legend(entries.values(), entries, loc="outside lower center", ncols=columns, **settings)


def limits(values: Tensor, margin: float = 0.3) -> tuple[float, float]:
    """Return the ends of a linear axis for these values.

    Short peaks of more than 20 times the 95th percentile do not count.
    """
    finite = values[torch.isfinite(values)].double()
    if not len(finite):
        return -1.0, 1.0
    usual = float(finite.abs().quantile(0.95))
    if float(finite.abs().max()) > 20 * usual > 0:
        finite = finite.clamp(-2 * usual, 2 * usual)
    low, high = float(finite.min()), float(finite.max())
    margin = margin * (high - low) or 0.1 * abs(high) or 1.0
    return low - margin, high + margin


def log_limits(curves: Sequence[Tensor]) -> tuple[float, float]:
    """Return the ends of a logarithmic axis: three decades on both sides of the best curve."""
    positive = [curve[(curve > 0) & torch.isfinite(curve)].double() for curve in curves]
    positive = [curve for curve in positive if len(curve)]
    if not positive:
        return 0.1, 1.0
    best = min(float(curve.median()) for curve in positive)
    low = min(float(curve.min()) for curve in positive)
    high = max(float(curve.max()) for curve in positive)
    return max(low, 1e-3 * best) / 1.5, 1.5 * min(high, 1e3 * best)


def set_log_axis(ax: Axes, curves: Sequence[Tensor]) -> None:
    """Make a vertical axis logarithmic, with ends that fit the curves."""
    ax.set_yscale("log")
    low, high = log_limits(curves)
    ax.set_ylim(low, high)
    if high > 10 * low:
        ax.yaxis.set_minor_formatter(NullFormatter())


def mean_error_figure(
    models: Mapping[str, Errors],
    baselines: Mapping[str, Errors],
    *,
    title: str,
    label: str,
    note: str,
    lost: str,
) -> Figure:
    """Draw the mean error over time of each model with its 10-90 % band, on a logarithmic axis.

    The start is not drawn, since its error may be 0. Baselines are thin grey means without a band.

    Args:
        models, baselines: names and errors; the order of the models fixes their colors.
        title: title of the figure.
        label: name and unit of the error.
        note: title of the legend.
        lost: word for excluded trajectories, such as "diverged", which the legend counts.
    """
    figure = Figure(figsize=(8, 4.8), layout="constrained")
    ax = figure.subplots()
    styles = [model_style(k) | {"linewidth": 1.8} for k in range(len(models))]
    styles += [baseline_style(k) for k in range(len(baselines))]
    means, highest = [], 0.0
    curves = [*models.items(), *baselines.items()]
    for k, ((name, (t, error, excluded)), style) in enumerate(zip(curves, styles, strict=True)):
        count = int(excluded.sum())
        text = f"{name} ({count} of {len(error)} {lost})" if count else name
        values = error[~excluded][:, 1:].double()
        if not len(values):
            ax.plot([], [], label=text, **style)
            continue
        means.append(values.mean(dim=0))
        ax.plot(t[1:], means[-1], label=text, **style)
        if k < len(models):
            ends = torch.tensor([0.1, 0.9], dtype=values.dtype)
            low, high = values.quantile(ends, dim=0)
            ax.fill_between(t[1:], low, high, color=style["color"], alpha=0.18, linewidth=0)
        highest = max(highest, float(values.max()))
    ax.set(yscale="log", xlabel="time [s]", ylabel=label)
    if highest > 0:
        ax.set_ylim(log_limits(means)[0], 2 * highest)
    ax.set_xlim(0, max(float(errors.t[-1]) for _, errors in curves))
    ax.grid(True, alpha=0.3)
    legend_below(figure, columns=4, title=note, fontsize="small")
    figure.suptitle(title, fontsize="medium")
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG at 150 dpi, and create its folder."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path) as partial:
        figure.savefig(partial, format="png", dpi=150)
