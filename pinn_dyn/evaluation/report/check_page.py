"""The page of the check of a log."""

from __future__ import annotations

from matplotlib.figure import Figure

from pinn_dyn.evaluation.log_check import LogCheck
from pinn_dyn.evaluation.log_figures import cleaning_figure
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

_INPUTS = (
    "The curve shows the share of the equation of motion that stays unexplained if an input is "
    "shifted by a delay. The delay is at its minimum. The column ± is half its 95 % interval. "
    "Dry friction is a share of the standard deviation of the input."
)


def check_report(check: LogCheck, *, command: str) -> str:
    """Return the HTML page of a check: verdict, measurements, delay curves, cleaning."""
    source = check.source
    verdict = [paragraph(text) for text in check.problems or ["A training makes sense."]]
    verdict += [paragraph(f"Warning: {text}") for text in check.warnings]
    if check.steps:
        text = "Steps that follow from the measured delay and noise, to append to the data set:"
        verdict += [paragraph(text), preformatted(check.block)]
    if check.options:
        verdict.append(paragraph(f"Options of a training: model=lnn {' '.join(check.options)}"))
    cleaning = cleaning_figure(
        source.cleaned[0], title=source.name, labels=source.labels, input_labels=source.input_labels
    )
    measurements = check.table()[["verdict", "measurement", "of", "value", "expected", "docs"]]
    notes = details("Notes of each step", from_markdown(source.report))
    sections = [
        Section("Verdict", verdict),
        Section("Measurements", [table(measurements)]),
        Section("Clock", [table(check.runs)]),
        Section("Coordinates", [table(check.coordinates)]),
    ]
    if check.rigid is not None:
        text = (
            f"The regressor of {check.rigid.count} base parameters has the condition number "
            f"{check.rigid.condition:.3g}; below 100 a motion is well conditioned. "
            f"Not determined: {check.rigid.undetermined}."
        )
        sections.append(Section("Rigid bodies", [paragraph(text), table(check.rigid.joints)]))
    if check.delays:
        curves = drawing(_delays(check), "unexplained share over the delay")
        parts = [paragraph(_INPUTS), table(check.inputs), curves]
        sections.append(Section("Inputs and their delays", parts))
    drawn = drawing(cleaning, "raw and cleaned signals")
    sections.append(Section("Cleaning", [drawn, notes]))
    return page(f"{source.name}: check of the log", command, sections)


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
