"""A figure of a log before and after its cleaning."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure

from pinn_dyn.data.logs import Cleaned
from pinn_dyn.evaluation.drawing import COLOURS, TRUTH, Line, Panel, names
from pinn_dyn.evaluation.png import motion_png


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
    looks = [(raw, "log", TRUTH, True)]
    looks += [(part, "cleaned", COLOURS[0], False) for part in cleaned.clean]
    columns = []
    for signal, titles in (("q", labels), ("v", speeds), ("u", input_labels)):
        panels = []
        for k, label in enumerate(titles):
            lines = []
            for part, name, colour, dots in looks:
                values = getattr(part, signal)
                if values is not None and k < values.shape[1]:
                    t, y = (torch.from_numpy(x.copy()) for x in (part.t, values[:, k]))
                    lines.append(Line(name, t, y[None], colour, width=1.0, dots=dots))
            panels.append(Panel(label, lines))
        columns.append(panels)
    return motion_png(columns, 0, title=f"{title}: {raw.run}, {cleaned.split}")
