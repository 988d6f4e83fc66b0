"""Figures of a log check: forces over time, residuals over the state, residuals over delays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from pinn_dyn.data.logs import Columns
from pinn_dyn.log_check.delay import DelayCurve
from pinn_dyn.log_check.runs import Equation
from pinn_dyn.plots import COLORS, TRUTH, legend_below, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DRAWN = 1000  # rows of the equation of motion
_BINS, _FEWEST = 40, 5  # parts of the range of a state; rows of a part


def forces(motion: Equation, inputs: Sequence[str]) -> Figure:
    """Draw y, X theta and the residual of each equation of motion in the longest run.

    ``inputs`` are labels of the inputs with their units.
    """
    labels = inputs[: len(motion.labels)] if motion.of_forces else motion.labels
    data = motion.data
    rows = np.flatnonzero(data.run == np.bincount(data.run).argmax())[:_DRAWN]
    t = data.t[rows]
    breaks = np.flatnonzero(np.diff(t) > 10 * np.median(np.diff(t))) + 1  # between stretches
    measured, explained = motion.y[rows], motion.predicted()[rows]
    figure, (axes,) = panels([labels], t, title="Forces and the equation of motion, means removed")
    curves = {
        "measured": (measured, TRUTH),
        "explained": (explained, COLORS[0]),
        "residual": (measured - explained, COLORS[1]),
    }
    for name, (values, color) in curves.items():
        gaps = np.insert(values, breaks, np.nan, axis=0)
        for ax, column in zip(axes, gaps.T, strict=True):
            ax.plot(np.insert(t, breaks, np.nan), column, color=color, linewidth=1.0, label=name)
    legend_below(figure)
    return figure


def residuals(motion: Equation, q: Columns, v: Columns | None, u: Columns) -> Figure | None:
    """Draw the residual of each force over position and speed of its joint; None for others.

    Args:
        motion: equation of motion of each joint.
        q, v: columns of the log, whose units the axes have; without v those of q per second.
        u: columns of the forces, which are drawn in SI units.
    """
    from matplotlib.figure import Figure  # takes a quarter of a second

    count = len(q.columns)
    if not motion.of_joints:
        return None
    figure = Figure(figsize=(9.0, 1.7 * count + 0.8), layout="constrained")
    grid = figure.subplots(count, 2, squeeze=False, sharey="row")
    states = {"q": q.from_si(motion.data.q), "v": motion.data.v / q.factors}
    names = {"q": q.columns, "v": [f"d/dt {x}" for x in q.columns]}
    units = {"q": q.unit, "v": [f"{x}/s" for x in q.unit]}
    if v is not None:
        states["v"], names["v"], units["v"] = v.from_si(motion.data.v), v.columns, v.unit
    left = motion.y - motion.predicted()
    friction = motion.part(motion.friction)
    for k, label in enumerate(motion.labels):
        moving = motion.data.moving[:, k]
        forces = {"q": left[:, k], "v": left[:, k] + friction[:, k]}
        for ax, key in zip(grid[k], states, strict=True):
            x, y = states[key][moving, k], forces[key][moving]
            ax.plot(x, y, ".", color=COLORS[1], markersize=1.5, alpha=0.3)
            ax.plot(*_means(x, y), color=COLORS[0], linewidth=1.5)
            ax.axhline(0, color="gray", linewidth=0.6)
            ax.set_xlabel(f"{names[key][k]} [{units[key][k]}]")
        grid[k, 0].set_ylabel(f"{label}: residual [{u.units[k]}]")
    title = "Residual force over position, and over speed with dry friction; lines: means"
    figure.suptitle(title, fontsize="medium")
    return figure


def delay_curves(curves: Sequence[DelayCurve], names: Sequence[str]) -> Figure:
    """Draw the residual over the delay of each input, of both equations where they differ."""
    from matplotlib.figure import Figure  # takes a quarter of a second

    figure = Figure(figsize=(9, 3.6), layout="constrained")
    ax = figure.subplots()
    for k, (name, curve) in enumerate(zip(names, curves, strict=True)):
        ax.plot(1e3 * curve.candidates, 100 * curve.residual, color=f"C{k}", label=name)
        if curve.delay is not None:
            ax.axvline(1e3 * curve.delay, color=f"C{k}", linewidth=0.8, linestyle="--")
        if (other := curve.other) is not None:
            label = f"{name}, {other.form}"
            ax.plot(1e3 * other.candidates, 100 * other.residual, f"C{k}:", label=label)
    ax.set(xlabel="delay (ms)", ylabel="unexplained (%)", yscale="log")
    ax.legend(fontsize="small")
    return figure


def _means(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centers and means of y in equal parts of the range of x; NaN for few points."""
    edges = np.linspace(x.min(initial=0.0), x.max(initial=1e-9), _BINS + 1)
    part = np.clip(np.digitize(x, edges) - 1, 0, _BINS - 1)
    counts = np.bincount(part, minlength=_BINS)
    means = np.bincount(part, y, minlength=_BINS) / np.where(counts >= _FEWEST, counts, np.nan)
    return (edges[1:] + edges[:-1]) / 2, means
