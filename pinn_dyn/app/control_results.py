"""Write tables, figures, animation and reports of control.py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

from pinn_dyn.atomic_files import write_whole
from pinn_dyn.control import ClosedLoopRecord, Helix, Reference
from pinn_dyn.data import DataSource
from pinn_dyn.evaluation import (
    ControlResult,
    animate,
    closed_loop_figure,
    controller_comparison_figure,
    save,
    tip_path_figure,
)
from pinn_dyn.evaluation.control_figures import ERROR, control_errors
from pinn_dyn.evaluation.report.control_page import control_report, shown_columns
from pinn_dyn.evaluation.report.page import Origin
from pinn_dyn.evaluation.tables import to_text, with_unit
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.systems import Drawable, HasTip


def write_results(
    result: ControlResult,
    source: DataSource,
    robot: MechanicalSystem,
    reference: Reference,
    config: dict[str, Any],
    folder: Path,
    origin: Origin,
) -> float:
    """Write tables, figures, animation and report; return the RMS error of the first law."""
    records, summary = result.records, result.table
    first = next(iter(records))
    result.save(folder)
    figures = _figures(records, source, robot, reference, config)
    for name, figure in figures.items():
        save(figure, folder / f"{name}.png")
    animation: Path | None = None
    if config["animate"] and isinstance(robot, Drawable):
        animation = folder / f"animation_{first}.gif"
        animate(records[first], config["trajectory"], robot, animation)

    runs = len(records[first].stopped)
    print(f"\n{source.name}: {runs} run{'s' if runs > 1 else ''} of {config['duration']:g} s")
    print(to_text(summary, shown_columns(summary)))
    report = control_report(
        title=f"{source.name}: closed loop on a learned model",
        result=result,
        figures=figures,
        labels=source.labels,
        animation=animation,
        origin=origin,
    )
    write_whole(folder / "report.html", report)
    print(f"\ntables, figures and records are in {folder}; open report.html in a browser")
    return result.metrics[first].summary["rms_error"]


def _figures(
    records: dict[str, ClosedLoopRecord],
    source: DataSource,
    robot: MechanicalSystem,
    reference: Reference,
    config: dict[str, Any],
) -> dict[str, Figure]:
    run = config["trajectory"]
    title = f"{source.name}: error of the closed loop"
    label = with_unit(ERROR, source.labels)
    figures = {"comparison": controller_comparison_figure(records, title=title, label=label)}
    errors = [control_errors(x).nan_to_num(torch.inf).mean(1) for x in records.values()]
    for k in dict.fromkeys([run, *sorted({int(x.argmax()) for x in errors})]):
        figures["closed_loop" if k == run else f"closed_loop_run_{k}"] = closed_loop_figure(
            records,
            k,
            title=f"{source.name}, run {k}" + ("" if k == run else " (the worst of a law)"),
            labels=source.labels,
            input_labels=source.input_labels,
        )
    if isinstance(reference, Helix) and isinstance(robot, HasTip):
        t = next(iter(records.values())).t
        lost = {name: x.q[run].isnan().any(-1, keepdim=True) for name, x in records.items()}
        figures["tip_path"] = tip_path_figure(
            t,
            {
                name: robot.tip_position(x.q[run].nan_to_num()).where(~lost[name], torch.nan)
                for name, x in records.items()
            },
            torch.stack([torch.as_tensor(reference.path(float(time))) for time in t]),
            title=f"{source.name}: path of the end effector",
        )
    return figures
