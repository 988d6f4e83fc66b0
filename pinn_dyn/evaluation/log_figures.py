"""A figure of a log before and after its cleaning."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from pinn_dyn.data.logs import Cleaned
from pinn_dyn.evaluation.drawing import names

_RAW = "0.65"
_CLEAN = "#0072B2"


def cleaning_figure(
    cleaned: Cleaned,
    *,
    title: str,
    labels: list[str],
    input_labels: list[str],
) -> Figure:
    """Raw dots and cleaned lines of one stretch: a column each for q, v and u.

    A velocity or an input rate that the log does not have has lines only.

    Args:
        cleaned: the stretch, one of ``LogSource.cleaned``.
        title: data set; the run is added to it.
        labels: name and unit of each coordinate.
        input_labels: name and unit of each input.

    Raises:
        ValueError: on labels that do not fit.
    """
    raw = cleaned.raw
    inputs = [raw, *cleaned.clean][-1].u.shape[1]
    labels = names(labels, "q", raw.q.shape[1], "labels")
    input_labels = names(input_labels, "u", inputs, "input_labels")
    speeds = [f"d/dt {label.replace(']', '/s]')}" for label in labels]
    columns = {"q": labels, "v": speeds, "u": input_labels}
    rows = max(len(labels), len(input_labels))
    figure = Figure(figsize=(12, 1.5 * rows + 1.4), layout="constrained")
    axes = figure.subplots(rows, 3, sharex=True, squeeze=False)
    for column, (signal, titles) in enumerate(columns.items()):
        for row in range(rows):
            ax = axes[row, column]
            if row >= len(titles):
                ax.set_axis_off()
                continue
            before = getattr(raw, signal)
            if before is not None and row < before.shape[1]:
                ax.plot(raw.t, before[:, row], ".", color=_RAW, markersize=3)
            for part in cleaned.clean:
                ax.plot(part.t, getattr(part, signal)[:, row], color=_CLEAN, linewidth=1)
            ax.set_ylabel(titles[row], fontsize="small")
            if row == len(titles) - 1:
                ax.set_xlabel("time (s)")
                ax.tick_params(labelbottom=True)
    axes[0, 0].set_xlim(raw.t[0], raw.t[-1])
    axes[0, 0].plot(np.nan, np.nan, ".", color=_RAW, label="log")
    axes[0, 0].plot(np.nan, np.nan, color=_CLEAN, label="cleaned")
    handles, texts = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, texts, loc="outside lower center", ncols=2)
    figure.suptitle(f"{title}: {raw.run}, {cleaned.split}")
    return figure
