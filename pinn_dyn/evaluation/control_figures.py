"""Figures of closed loops."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from pinn_dyn.control.record import ClosedLoopRecord
from pinn_dyn.evaluation.control_metrics import samples_before_stop, stopped_runs
from pinn_dyn.evaluation.drawing import (
    COLOURS,
    DARK,
    TRUTH,
    Line,
    Panel,
    error_panel,
    look,
    names,
    with_unit,
)
from pinn_dyn.evaluation.png import mean_png, motion_png

ERROR = "‖q_ref − q‖₂"


def control_panels(
    records: Mapping[str, ClosedLoopRecord],
    labels: Sequence[str],
    input_labels: Sequence[str],
    *,
    held: bool = True,
) -> tuple[list[Panel], list[Panel]]:
    """A panel per coordinate, reached and dotted reference, the error below; and one per input.

    Args:
        records: names of laws and their K runs; the order fixes colours and dashes.
        labels, input_labels: name and unit of each coordinate and input.
        held: whether the input holds between two control instants.
    """
    laws = [(name, record, *look(k)) for k, (name, record) in enumerate(records.items())]
    first = laws[0][1]
    states = []
    for k, label in enumerate(labels):
        lines = [Line(name, r.t, r.q[..., k], c, d) for name, r, c, d in laws]
        wanted = Line("reference", first.t, first.reference.q[..., k], DARK, "dot", always=True)
        states.append(Panel(label, [*lines, wanted]))
    errors = [Line(name, r.t, control_errors(r), c, d) for name, r, c, d in laws]
    states.append(Panel(with_unit(ERROR, labels), errors, log=True))
    inputs = [
        Panel(label, [Line(name, r.t, r.u[..., k], c, d, held=held) for name, r, c, d in laws])
        for k, label in enumerate(input_labels)
    ]
    return states, inputs


def control_errors(record: ClosedLoopRecord) -> Tensor:
    """|q_ref - q|_2, ``(K, T)``."""
    return (record.reference.q - record.q).double().norm(dim=-1)


def control_error_panel(records: Mapping[str, ClosedLoopRecord], label: str = ERROR) -> Panel:
    """Errors of laws over time; the runs that were stopped are lost."""
    return error_panel(
        {name: (r.t, control_errors(r), stopped_runs(r)) for name, r in records.items()},
        label=label,
    )


def closed_loop_figure(
    record: ClosedLoopRecord,
    run: int,
    *,
    title: str,
    labels: Sequence[str] | None = None,
    input_labels: Sequence[str] | None = None,
) -> Figure:
    """One run: states over dotted references, the error, and the inputs.

    A run that was stopped has a line at that time, and the reason above.

    Args:
        record: K runs.
        run: which of the K to draw.
        title: plant and controller.
        labels: name and unit of each coordinate; None takes q1 ... qN.
        input_labels: name and unit of each input; None takes u1 ... uM.

    Raises:
        ValueError: on labels that do not fit.
    """
    labels = names(labels, "q", record.q.shape[-1], "labels")
    inputs = names(input_labels, "u", record.u.shape[-1], "input_labels")
    columns = control_panels({"reached": record}, labels, inputs)
    reason, end = record.stopped[run], None
    if reason is not None:
        end = float(record.t[samples_before_stop(record, run) - 1])
        title += f"\nstopped: {reason}"
    return motion_png(columns, run, title=title, end=end)


def controller_comparison_figure(
    records: Mapping[str, ClosedLoopRecord], *, title: str, label: str = ERROR
) -> Figure:
    """Error over time: per controller the mean over its runs and their 10-90 % band.

    Stopped runs are left out of both and counted in the legend.

    Args:
        records: controller names and their runs; the order of the names fixes their colours.
        title: plant and task.
        label: name and unit of the error.
    """
    note = "mean over runs, 10–90 % band"
    return mean_png(control_error_panel(records, label), title=title, note=note, lost="stopped")


def tip_path_figure(t: Tensor, paths: dict[str, Tensor], wanted: Tensor, *, title: str) -> Figure:
    """Path of the end effector in space, and its distance to the wanted path over time.

    The distance is to where the end effector should be at the same time.

    Args:
        t: times, ``(T,)``, s.
        paths: names and positions, ``(T, 3)`` each, m; NaN after a stop. The order of the names
            fixes their colours.
        wanted: wanted positions, ``(T, 3)``, m.
        title: plant and task.

    Raises:
        ValueError: on a path of another shape.
    """
    for name, path in {"wanted": wanted, **paths}.items():
        if path.shape != (len(t), 3):
            raise ValueError(
                f"path {name!r} has shape {tuple(path.shape)}, expected {(len(t), 3)}: one "
                "position for each time"
            )
    figure = Figure(figsize=(11, 5), layout="constrained")
    space = figure.add_subplot(1, 2, 1, projection="3d")
    ax = figure.add_subplot(1, 2, 2)
    space.plot(*wanted.T.numpy(), color=TRUTH, linewidth=5, label="wanted")
    for index, (name, path) in enumerate(paths.items()):
        colour = look(index)[0]
        space.plot(*path.T.numpy(), color=colour, linewidth=1.3, label=name)
        distance = 1e3 * (path - wanted).norm(dim=-1)
        ax.plot(t, distance, color=colour, linewidth=1.3)
        kept = int(torch.isfinite(distance).sum())
        if 0 < kept < len(t):
            end = kept - 1
            space.scatter(*path[end].numpy(), color=colour, marker="x", s=50)
            ax.plot(t[end], distance[end], "x", color=colour, markersize=8)
            place = (float(t[end]), float(distance[end]))
            ax.annotate(
                f"{name} stopped", place, (6, 6), textcoords="offset points", fontsize="small"
            )
    space.scatter(*wanted[0].numpy(), color="black", s=25, label="start")
    space.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)")
    space.set_aspect("equal")
    space.locator_params(nbins=4)
    ax.set_xlabel("time (s)")
    ax.set_ylabel("distance to the wanted position (mm)")
    ax.set_xlim(float(t[0]), float(t[-1]))
    ax.set_ylim(bottom=0)
    ax.grid(True, alpha=0.3)
    handles, names = space.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4)
    figure.suptitle(title)
    return figure


def steady_state_figure(
    bound: Tensor, measured: Tensor, *, title: str, label: str = ERROR
) -> Figure:
    """Steady-state error of each set point against its predicted bound, on two log axes.

    A bound holds below the diagonal; what lies above it is drawn as a cross in a warning colour.
    The title counts the bounds that hold, and what cannot be drawn: set points without a finite
    bound, and those with one but without a finite error, whose bound does not hold.

    Args:
        bound: predicted bounds, ``(K,)``, in the units of q.
        measured: steady-state errors, ``(K,)``, in the units of q.
        title: plant and controller.
        label: name and unit of the error.

    Raises:
        ValueError: on two shapes that differ.
    """
    if bound.ndim != 1 or bound.shape != measured.shape:
        raise ValueError(
            f"bound has shape {tuple(bound.shape)} and measured {tuple(measured.shape)}: expected "
            "(K,) twice"
        )
    bounded = torch.isfinite(bound)
    drawn = bounded & torch.isfinite(measured)
    x, y = (values[drawn].double().clamp(min=1e-12) for values in (bound, measured))  # log axes
    above = y > x
    figure = Figure(figsize=(6.5, 6.0), layout="constrained")
    ax = figure.subplots()
    ax.set(xscale="log", yscale="log", aspect="equal")
    ax.scatter(x[~above], y[~above], s=28, color=COLOURS[0], label="below its bound")
    if above.any():
        ax.scatter(x[above], y[above], s=40, color=COLOURS[1], marker="x", label="above its bound")
    if len(x):
        both = torch.cat([x, y])
        ends = (0.5 * float(both.min()), 2 * float(both.max()))
        ax.plot(ends, ends, "--", color="0.4", linewidth=1, label="error = bound")
        ax.set(xlim=ends, ylim=ends)
    ax.grid(True, which="major", alpha=0.3)
    ax.set(xlabel=f"predicted bound on {label}", ylabel=f"measured {label}")
    ax.legend(loc="upper left", fontsize="small")
    lines = [title, f"{int((~above).sum())} of {int(bounded.sum())} bounds hold"]
    unbounded, endless = int((~bounded).sum()), int((bounded & ~drawn).sum())
    if unbounded or endless:
        lines.append(f"not drawn: {unbounded} without a bound, {endless} without a finite error")
    figure.suptitle("\n".join(lines), fontsize="medium")
    return figure
