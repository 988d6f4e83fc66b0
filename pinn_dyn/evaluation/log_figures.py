"""A figure of a log before and after its cleaning."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from pinn_dyn.data.logs import Cleaned

_RAW = "0.65"
_CLEAN = "#0072B2"


def cleaning_figure(
    cleaned: Cleaned,
    *,
    title: str,
    labels: list[str],
    input_labels: list[str],
    times: tuple[float, float] | None = None,
) -> Figure:
    """Raw dots and cleaned lines of one stretch: a column each for q, v and u.

    A velocity or an input rate that the log does not have has lines only.

    Args:
        cleaned: the stretch, one of ``LogSource.cleaned``.
        title: data set; the run is added to it.
        labels, input_labels: name and unit of each coordinate and input.
        times: first and last time to draw, on the log's clock, s; None draws all.

    Raises:
        ValueError: on labels that do not fit, or times at which the log has no rows.
    """
    raw = cleaned.raw
    for name, given, width in (
        ("labels", labels, raw.q.shape[1]),
        ("input_labels", input_labels, [raw, *cleaned.clean][-1].u.shape[1]),
    ):
        if len(given) != width:
            raise ValueError(f"{name} has {len(given)} entries, expected {width}: {given}")
    first, last = times or (float(raw.t[0]), float(raw.t[-1]))
    shown = (raw.t >= first) & (raw.t <= last)
    if not shown.any():
        raise ValueError(f"times is {times}, expected some of {raw.t[0]:g} to {raw.t[-1]:g} s")
    speeds = [f"d/dt {label.replace(']', '/s]')}" for label in labels]
    columns = {"q": labels, "v": speeds, "u": input_labels}
    rows = max(len(labels), len(input_labels))
    figure = Figure(figsize=(12, 1.5 * rows + 1.4), layout="constrained")
    axes = figure.subplots(rows, 3, sharex=True, squeeze=False)
    for column, (signal, names) in enumerate(columns.items()):
        for row in range(rows):
            ax = axes[row, column]
            if row >= len(names):
                ax.set_axis_off()
                continue
            before = getattr(raw, signal)
            if before is not None and row < before.shape[1]:
                ax.plot(raw.t[shown], before[shown, row], ".", color=_RAW, markersize=3)
            for part in cleaned.clean:
                seen = (part.t >= first) & (part.t <= last)
                values = getattr(part, signal)[seen, row]
                ax.plot(part.t[seen], values, color=_CLEAN, linewidth=1)
            ax.set_ylabel(names[row], fontsize="small")
            if row == len(names) - 1:
                ax.set_xlabel("time (s)")
                ax.tick_params(labelbottom=True)
    axes[0, 0].set_xlim(first, last)
    axes[0, 0].plot(np.nan, np.nan, ".", color=_RAW, label="log")
    axes[0, 0].plot(np.nan, np.nan, color=_CLEAN, label="cleaned")
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2)
    figure.suptitle(f"{title}: {raw.run}, {cleaned.split}")
    return figure
