"""Figure of a log before and after its cleaning."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pinn_dyn.data.logs import Cleaned
from pinn_dyn.plots import COLORS, TRUTH, legend_below, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def cleaning_figure(
    cleaned: Cleaned, *, title: str, labels: list[str], input_labels: list[str]
) -> Figure:
    """Draw raw samples as dots and cleaned signals as lines: a column each for q, v and u.

    ``cleaned`` is one of ``LogSource.cleaned``. The labels are names and units of q and u.
    """
    raw = cleaned.raw
    speeds = [f"d/dt {label.replace(']', '/s]')}" for label in labels]
    title = f"{title}: {raw.run}, {cleaned.split}"
    figure, axes = panels([labels, speeds, input_labels], raw.t, title=title)
    dots: dict[str, Any] = {"color": TRUTH, "linestyle": "none", "marker": ".", "markersize": 3}
    styles: list[tuple[Any, dict[str, Any]]] = [(raw, dots | {"label": "log"})]
    styles += [
        (x, {"color": COLORS[0], "linewidth": 1.0, "label": "cleaned"}) for x in cleaned.clean
    ]
    for part, style in styles:
        for column, values in zip(axes, (part.q, part.v, part.u), strict=True):
            for k, ax in enumerate(column):
                if values is not None and k < values.shape[1]:
                    ax.plot(part.t, values[:, k], **style)
    legend_below(figure)
    return figure
