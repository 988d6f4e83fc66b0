"""The page of a log's check."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from pinn_dyn.data.logs import LogSource
from pinn_dyn.evaluation.log_check import LogCheck
from pinn_dyn.evaluation.log_figures import cleaning_figure
from pinn_dyn.evaluation.plots import model_style
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
from pinn_dyn.evaluation.rigid_excitation import MOST


def check_report(check: LogCheck, source: LogSource, *, command: str) -> str:
    """The HTML page: verdict, tables, delay curves, coverage, cleaning.

    Args:
        check: the findings.
        source: the log.
        command: the command line that made them.
    """
    verdict = ["A training makes sense."] if not check.problems else check.problems
    facts = pd.DataFrame({"what": check.figures.keys(), "value": check.figures.values()})
    parts = [paragraph(text) for text in verdict]
    parts += [paragraph(f"Warning: {text}") for text in check.warnings]
    parts.append(table(facts, headers={"what": "", "value": " "}))
    parts += [
        paragraph("To copy into the configuration, and to run; each line with its reason:"),
        preformatted(check.suggestion),
    ]
    sections = [
        Section("Verdict", parts),
        Section("Clock", [table(check.runs), drawing(_clock(source), "time between rows")]),
        Section(
            "Coordinates",
            [
                paragraph(
                    "Noise is what third differences leave; of v, where the log has one. The "
                    "floors of q and v, where motions come twice, are what both differ by, over "
                    "√2: noise, and all that is not the same in both. No model errs less."
                ),
                paragraph(
                    "The own share of an acceleration is what 1, its own q and v, and the other "
                    "accelerations do not explain of it: below a hundredth its inertia cannot be "
                    "identified. Not identified: "
                    f"{', '.join(check.unidentified) or 'none'}. This and the condition number "
                    "are of the linear regressor (1, q, v, a), as a log has no bodies; those of a "
                    "rigid robot are below, where its kinematics is given (model/structure=...)."
                ),
                table(check.coordinates),
                drawing(_coverage(check, source), "coverage of the test by the training"),
            ],
        ),
        *_rigid(check),
        Section(
            "Inputs and their delays",
            [
                paragraph(
                    "What the equation of motion, by least squares, leaves unexplained when an "
                    "input is taken d earlier. A delay is where it is least."
                ),
                table(check.inputs),
                drawing(_delays(check), "unexplained share over the delay"),
            ],
        ),
        Section(
            "Cleaning",
            [
                drawing(
                    cleaning_figure(
                        source.cleaned[0],
                        title=source.name,
                        labels=source.labels,
                        input_labels=source.input_labels,
                    ),
                    "raw and cleaned signals",
                ),
                details("What each step did", from_markdown(source.report)),
            ],
        ),
    ]
    return page(f"{check.name}: check of the log", command, sections)


def _rigid(check: LogCheck) -> list[Section]:
    """What the motions tell of rigid bodies, where their kinematics is known."""
    if check.rigid is None:
        return []
    return [
        Section(
            "Rigid bodies",
            [
                paragraph(
                    f"The torques of rigid bodies and their drives are linear in "
                    f"{check.rigid.count} base parameters. The regressor of the training motions, "
                    "each column of unit norm, has the condition number "
                    f"{check.rigid.condition:.3g}; below {MOST:g} a motion is well conditioned. "
                    "Directions with less than a hundredth of the largest singular value are not "
                    f"determined: {check.rigid.words(len(check.rigid.undetermined))}. The own "
                    "share of the weakest parameter is what the other columns do not explain of "
                    "its own."
                ),
                table(check.rigid.joints),
            ],
        )
    ]


def _clock(source: LogSource) -> Figure:
    figure = Figure(figsize=(9, 2.6), layout="constrained")
    ax = figure.subplots()
    for index, part in enumerate(source.cleaned[:6]):
        ax.plot(
            part.raw.t[1:],
            1e3 * np.diff(part.raw.t),
            ".",
            color=model_style(index)["color"],
            markersize=2,
        )
    ax.set(xlabel="time (s)", ylabel="time between rows (ms)")
    return figure


def _delays(check: LogCheck) -> Figure:
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    ax = figure.subplots()
    for index, (name, curve) in enumerate(zip(check.inputs["input"], check.delays, strict=True)):
        colour = model_style(index)["color"]
        ax.plot(1e3 * curve.candidates, 100 * curve.residual, color=colour, label=name)
        if curve.delay is not None:
            ax.axvline(1e3 * curve.delay, color=colour, linewidth=0.8, linestyle="--")
    ax.set(xlabel="delay (ms)", ylabel="unexplained (%)", yscale="log")
    ax.legend(fontsize="small")
    return figure


def _coverage(check: LogCheck, source: LogSource) -> Figure:
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    splits = source.load()
    for name, colour, items in (
        ("training", "0.7", splits.train),
        ("test", model_style(0)["color"], splits.test),
    ):
        q = np.vstack([np.hstack([item.q[:, :2].numpy(), item.v[:, :1].numpy()]) for item in items])
        if len(source.labels) > 1:
            q = q[:, :2]
        q = q[:: max(1, len(q) // 4000)]
        left.plot(q[:, 0], q[:, -1], ".", color=colour, markersize=2, label=name)
    left.set(xlabel=source.labels[0], ylabel=[*source.labels, "its velocity"][1])
    left.legend(fontsize="small")
    right.hist(check.distance, bins=40, color=model_style(0)["color"])
    right.set(xlabel="distance of a test sample from the training", ylabel="samples")
    return figure
