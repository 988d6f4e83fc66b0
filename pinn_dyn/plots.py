"""Plotting basics that all figures share: colors, labels, panels over time, PNG files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from pinn_dyn.atomic_files import whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The palette of Okabe and Ito, which color-blind readers can tell apart.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
TRUTH, BASELINE, DARK = "#b3b3b3", "#9aa5ae", "#24303c"
_LINE_STYLES = ("-", "--", ":", "-.")


Errors = tuple[Tensor, Tensor, Tensor]
"""Times ``(T,)`` in s, errors ``(K, T)``, and trajectories ``(K,)`` that no mean contains, bool."""


def model_style(index: int) -> dict[str, Any]:
    """Return the line style of a model or control law by its index, the same in all figures."""
    dashes = _LINE_STYLES[index // len(COLORS) % len(_LINE_STYLES)]
    return {"color": COLORS[index % len(COLORS)], "linestyle": dashes}


def baseline_style(index: int) -> dict[str, Any]:
    """Return the line style of a baseline: thin and grey."""
    dashes = _LINE_STYLES[index % len(_LINE_STYLES)]
    return {"color": BASELINE, "linestyle": dashes, "linewidth": 1.0}


def default_labels(labels: Sequence[str] | None, letter: str, count: int) -> list[str]:
    """Return the labels, or q1 ... qN without any."""
    return list(labels) if labels else [f"{letter}{k + 1}" for k in range(count)]


def panels(
    columns: Sequence[Sequence[str]], t: Tensor | np.ndarray, *, title: str
) -> tuple[Figure, list[list[Axes]]]:
    """Create columns of panels over the times t in s; return the axes of each column.

    ``columns`` has the label of the vertical axis of each panel, for each column. A column without
    panels takes no place.
    """
    from matplotlib.figure import Figure  # takes a quarter of a second

    filled = [labels for labels in columns if labels]
    rows = max(map(len, filled))
    figure = Figure(figsize=(5.8 * len(filled), 1.55 * rows + 1.3), layout="constrained")
    grid = figure.subplots(rows, len(filled), sharex=True, squeeze=False)
    shown = iter(grid.T)
    axes = [list(next(shown)[: len(labels)]) if labels else [] for labels in columns]
    for column, used, labels in zip(grid.T, filter(None, axes), filled, strict=True):
        for ax, label in zip(used, labels, strict=True):
            ax.set_ylabel(label)
            ax.grid(True, alpha=0.3)
        for ax in column[len(labels) :]:
            ax.set_axis_off()
        used[-1].set_xlabel("time [s]")
        used[-1].tick_params(labelbottom=True)
        figure.align_ylabels(column)
    grid[0, 0].set_xlim(float(t[0]), float(t[-1]))
    figure.suptitle(title, fontsize="medium")
    return figure, axes


def legend_below(figure: Figure, columns: int = 4, **settings: Any) -> None:
    """Add one legend below all panels, with each name once."""
    pairs = [zip(*ax.get_legend_handles_labels(), strict=True) for ax in figure.axes]
    entries = {name: handle for pair in pairs for handle, name in pair}
    columns = min(len(entries), columns)
    figure.legend(entries.values(), entries, loc="outside lower center", ncols=columns, **settings)


def limits(values: Tensor, margin: float = 0.3) -> tuple[float, float]:
    """Return the ends of a linear axis; peaks of 20 times the 95th percentile do not count."""
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
    """Return the ends of a logarithmic axis: three decades around the best curve, and its top."""
    positive = [curve[(curve > 0) & torch.isfinite(curve)].double() for curve in curves]
    positive = [curve for curve in positive if len(curve)] or [torch.ones(1)]
    best, top = min((float(curve.median()), float(curve.max())) for curve in positive)
    values = torch.cat(positive)
    low = max(float(values.min()), 1e-3 * best)
    high = min(float(values.max()), max(1e3 * best, top))
    return low / 1.5, 1.5 * high


def set_log_axis(ax: Axes, curves: Sequence[Tensor]) -> None:
    """Make a vertical axis logarithmic, with ends that fit the curves."""
    ax.set_yscale("log")
    low, high = log_limits(curves)
    ax.set_ylim(low, high)
    if high > 10 * low:
        from matplotlib.ticker import NullFormatter

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
        models, baselines: names and errors.
        title, note, label: titles of figure and legend, name and unit of the error.
        lost: word for excluded trajectories, such as "diverged", which the legend counts.
    """
    from matplotlib.figure import Figure

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
        means.append(values.mean(dim=0))
        ax.plot(t[1:], means[-1], label=text, **style)  # NaN without trajectories: legend only
        if k < len(models) and len(values):
            low, high = np.quantile(values, [0.1, 0.9], axis=0)
            ax.fill_between(t[1:], low, high, color=style["color"], alpha=0.18, linewidth=0)
        highest = max([highest, *values.amax(dim=1).tolist()])
    ax.set(yscale="log", xlabel="time [s]", ylabel=label)
    if highest > 0:
        ax.set_ylim(log_limits(means)[0], 2 * highest)
    ax.set_xlim(0, max(float(t[-1]) for _, (t, _, _) in curves))
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
