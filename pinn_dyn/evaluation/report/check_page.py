"""The page of the check of a log."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from pinn_dyn.data.logs.averages import PARTS
from pinn_dyn.evaluation.log_check import LogCheck
from pinn_dyn.evaluation.log_figures import cleaning_figure
from pinn_dyn.evaluation.plots import COLORS, TRUTH, legend_below, panels
from pinn_dyn.evaluation.report.page import (
    Section,
    details,
    drawing,
    from_markdown,
    page,
    paragraph,
    preformatted,
    table,
)

_DRAWN = 1000  # rows of the equation of motion
_FORCES = (
    "The equation of motion is fitted to all runs. The residual is the part of an input that the "
    "motion does not explain: friction that depends on the load, contacts, or a fault of the log."
)
_INPUTS = (
    "The curve shows the share of the equation of motion that stays unexplained if an input is "
    "shifted by a delay. The delay is at its minimum. The column ± is half its 95 % interval. "
    "Dry friction is a share of the standard deviation of the input."
)


def check_report(check: LogCheck, *, command: str) -> str:
    """Return the HTML page of a check: verdict, forces, what is not ok, and the rest folded."""
    source = check.source
    verdict = [paragraph(f"{check.verdict[0].upper()}{check.verdict[1:]}.")]
    if check.equations and check.motion is not None:
        text = "measured forces, the part that the equation of motion explains, and the residual"
        verdict += [paragraph(_FORCES), drawing(_forces(check), text)]
    verdict += [paragraph(text) for text in check.findings()]
    if check.block:
        text = "Entries that follow from the measured delay and noise, to append to the data set:"
        verdict += [paragraph(text), preformatted(check.block)]
    if check.options and check.rigid is None:
        verdict.append(paragraph(f"Options of a training: model=lnn {' '.join(check.options)}"))
    cleaning = cleaning_figure(
        source.cleaned[0], title=source.name, labels=source.labels, input_labels=source.input_labels
    )
    measurements = check.table()[["verdict", "measurement", "of", "value", "expected", "docs"]]
    parts = [
        details("All measurements", table(measurements)),
        details("Clock of each run", table(check.runs)),
        details("Coordinates", table(check.coordinates)),
    ]
    if check.rigid is not None:
        text = (
            f"The regressor of {check.rigid.count} base parameters has the condition number "
            f"{check.rigid.condition:.3g}; below 100 a motion is well conditioned. "
            f"Not determined: {check.rigid.undetermined}."
        )
        parts.append(details("Rigid bodies", paragraph(text), table(check.rigid.joints)))
    if check.delays:
        curves = drawing(_delays(check), "unexplained share over the delay")
        inputs = [paragraph(_INPUTS), table(check.inputs), curves]
        parts.append(details("Inputs and their delays", *inputs))
    drawn = drawing(cleaning, "raw and cleaned signals")
    parts.append(details("Cleaning", drawn, from_markdown(source.report)))
    sections = [Section("Verdict", verdict), Section("Measurements", parts)]
    return page(f"{source.name}: check of the log", command, sections)


def _forces(check: LogCheck) -> Figure:
    """Draw y, X theta and the residual of each equation of motion in the longest run."""
    assert check.motion is not None
    runs, counts = np.unique(check.motion.block // PARTS, return_counts=True)
    rows = np.flatnonzero(check.motion.block // PARTS == runs[counts.argmax()])[:_DRAWN]
    t = check.motion.t[rows]
    breaks = np.flatnonzero(np.diff(t) > 10 * np.median(np.diff(t))) + 1  # between stretches
    pairs = [equation.predicted() for equation in check.equations]
    measured, explained = (np.hstack(x)[rows] for x in zip(*pairs, strict=True))
    labels = [label for equation in check.equations for label in equation.labels]
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


def _delays(check: LogCheck) -> Figure:
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    ax = figure.subplots()
    for k, (name, curve) in enumerate(zip(check.inputs["input"], check.delays, strict=True)):
        ax.plot(1e3 * curve.candidates, 100 * curve.residual, color=f"C{k}", label=name)
        if curve.delay is not None:
            ax.axvline(1e3 * curve.delay, color=f"C{k}", linewidth=0.8, linestyle="--")
    ax.set(xlabel="delay (ms)", ylabel="unexplained (%)", yscale="log")
    ax.legend(fontsize="small")
    return figure
