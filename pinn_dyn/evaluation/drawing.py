"""What a figure of motions or errors shows, said once, for a PNG and for a page alike.

Drawn by :mod:`pinn_dyn.evaluation.png` (matplotlib) and by the interactive pages (plotly).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

# Okabe and Ito's palette, told apart by colour-blind readers.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DASHES = ("solid", "dash", "dot", "dashdot")
TRUTH = "#b3b3b3"
GREY = "#9aa5ae"
DARK = "#24303c"

_SPIKE = 20  # a peak this many times above the 95th percentile does not set the range


def look(index: int) -> tuple[str, str]:
    """Colour and dash of the model or law with this index, the same in all figures."""
    return COLOURS[index % len(COLOURS)], DASHES[index // len(COLOURS) % len(DASHES)]


@dataclass(frozen=True)
class Line:
    """A curve in each of K motions, or K curves that a mean and a band stand for.

    Attributes:
        name: its name in the legend; lines of one name are shown and hidden together.
        t: times, ``(T,)``, s.
        y: values, ``(K, T)``.
        colour, dash, width: how it is drawn.
        dots: whether its samples are dots without a line, in a PNG.
        held: whether a value holds until the next one.
        always: whether a menu that chooses among lines leaves it visible.
        lost: which of the K count as lost and are in no mean, ``(K,)``; None for none.
        band: whether a mean has its 10-90 % band.
    """

    name: str
    t: Tensor
    y: Tensor
    colour: str
    dash: str = "solid"
    width: float = 1.6
    dots: bool = False
    held: bool = False
    always: bool = False
    lost: Tensor | None = None
    band: bool = True

    def kept(self) -> Tensor:
        """The curves that were not lost, double precision."""
        return (self.y if self.lost is None else self.y[~self.lost]).double()

    def legend(self, what: str) -> str:
        """The name, and how many curves were lost to what, as "diverged"."""
        count = 0 if self.lost is None else int(self.lost.sum())
        return f"{self.name} ({count} of {len(self.y)} {what})" if count else self.name

    def statistics(self) -> tuple[Tensor, Tensor, Tensor] | None:
        """Mean, 10 % and 90 % quantile over the kept curves, ``(T,)`` each; None without any."""
        kept = self.kept()
        if not len(kept):
            return None
        low, high = torch.quantile(kept, torch.tensor([0.1, 0.9], dtype=kept.dtype), dim=0)
        return kept.mean(dim=0), low, high


@dataclass(frozen=True)
class Panel:
    """Axes of a figure over time.

    Attributes:
        label: name and unit of the vertical axis.
        lines: what is drawn.
        leading: the line that sets the range, so that a runaway does not flatten the others; None
            takes all lines.
        log: whether the vertical axis is logarithmic.
    """

    label: str
    lines: Sequence[Line]
    leading: Line | None = None
    log: bool = False

    def limits(self, motion: int) -> tuple[float, float]:
        """Ends of the vertical axis for one motion."""
        lines = self.lines if self.leading is None else [self.leading]
        every = [y[torch.isfinite(y)] for y in (line.y[motion].double() for line in lines)]
        values = torch.cat([torch.empty(0, dtype=torch.float64), *every])
        if self.log:
            values = values[values > 0]
            if not len(values):
                return 0.1, 1.0
            # An error may start from nothing and end anywhere: six decades around the best line.
            best = min(float(y[y > 0].median()) for y in every if (y > 0).any())
            return max(float(values.min()), 1e-2 * best) / 1.5, 1.5 * min(
                float(values.max()), 1e4 * best
            )
        if not len(values):
            return -1.0, 1.0
        usual = float(torch.quantile(values.abs(), 0.95))
        if float(values.abs().max()) > _SPIKE * usual > 0:
            values = values.clamp(-2 * usual, 2 * usual)
        low, high = float(values.min()), float(values.max())
        margin = (0.3 if self.leading else 0.08) * (high - low) or 0.1 * abs(high) or 1.0
        return low - margin, high + margin

    def limits_of_means(self) -> tuple[float, float] | None:
        """Ends of a logarithmic axis for the means; None where nothing is above zero.

        An error starts from nothing: three decades below the best line are enough of that.
        """
        means = [found[0] for line in self.lines if (found := line.statistics())]
        tops = [float(line.kept().max()) for line in self.lines if len(line.kept())]
        best = min((float(mean.median()) for mean in means), default=0.0)
        if not best > 0:
            return None
        lowest = min(float(mean[mean > 0].min()) for mean in means if (mean > 0).any())
        return max(1e-3 * best, 0.5 * lowest), 2 * max(tops)


def error_panel(
    curves: Mapping[str, tuple[Tensor, Tensor, Tensor]],
    *,
    label: str,
    floors: Mapping[str, tuple[Tensor, Tensor, Tensor]] | None = None,
) -> Panel:
    """Errors over time; the start is left out, as its error may be 0, which no log axis has.

    Args:
        curves: names, and of each the times ``(T,)``, the errors ``(K, T)`` and which of the K
            trajectories were lost, ``(K,)``; their order fixes the colours.
        label: name and unit of the error.
        floors: the same of what they have to beat, in thin grey lines.
    """
    lines = []
    for index, (name, (t, error, lost)) in enumerate(curves.items()):
        lines.append(Line(name, t[1:], error[:, 1:], *look(index), width=1.8, lost=lost))
    for index, (name, (t, error, lost)) in enumerate((floors or {}).items()):
        dash = DASHES[index % len(DASHES)]
        lines.append(Line(name, t[1:], error[:, 1:], GREY, dash, 1.0, lost=lost, band=False))
    return Panel(label, lines, log=True)


def names(given: Sequence[str] | None, letter: str, count: int, argument: str) -> list[str]:
    """The labels given, or q1 ... qN.

    Raises:
        ValueError: if there are more or less than ``count``.
    """
    found = list(given) if given else [f"{letter}{k + 1}" for k in range(count)]
    if len(found) != count:
        raise ValueError(f"{argument} has {len(found)} entries, expected {count}: {found}")
    return found


def units(labels: Sequence[str]) -> str:
    """The units of labels such as ``Δx [rad]`` or ``q1 (rad)``, each once; "" without any."""
    found = [re.search(r"[\[(]([^\[\]()]+)[\])]\s*$", label) for label in labels]
    return ", ".join(dict.fromkeys(match[1] for match in found if match))


def with_unit(text: str, labels: Sequence[str]) -> str:
    """The text with the units of the labels behind it."""
    unit = units(labels)
    return f"{text} [{unit}]" if unit else text
