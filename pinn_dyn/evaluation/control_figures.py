"""Figures of closed loops."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from pinn_dyn.control.closed_loop import ClosedLoopRecord
from pinn_dyn.evaluation.control_metrics import samples_before_stop, stopped_runs
from pinn_dyn.evaluation.tables import with_unit
from pinn_dyn.plots import (
    DARK,
    TRUTH,
    default_labels,
    legend_below,
    limits,
    mean_error_figure,
    model_style,
    panels,
    set_log_axis,
)

ERROR = "‖q_ref − q‖₂"


def control_errors(record: ClosedLoopRecord) -> Tensor:
    """Return the tracking error |q_ref - q|_2, ``(K, T)``."""
    return (record.reference.q - record.q).double().norm(dim=-1)


def closed_loop_figure(
    laws: Mapping[str, ClosedLoopRecord],
    run: int,
    *,
    title: str,
    labels: Sequence[str] | None = None,
    input_labels: Sequence[str] | None = None,
) -> Figure:
    """Draw one run: configuration over the dotted reference, the error, and the inputs.

    A dashed vertical line marks a stop.

    Args:
        laws: names of laws and K runs of each.
        run: index of the run.
        labels, input_labels: names and units; None takes q1 ... qN and u1 ... uM.
    """
    first = next(iter(laws.values()))
    labels = default_labels(labels, "q", first.q.shape[-1])
    input_labels = default_labels(input_labels, "u", first.u.shape[-1])
    columns = [[*labels, with_unit(ERROR, labels)], input_labels]
    for name, record in laws.items():
        if record.stopped[run] is not None:
            title += f"\n{name} stopped: {record.stopped[run]}"
    figure, (states, inputs) = panels(columns, first.t, title=title)
    *coordinates, error_panel = states
    for k, ax in enumerate(coordinates):
        goal = first.reference.q[run, :, k]
        ax.set_ylim(limits(torch.cat([goal, *(x.q[run, :, k] for x in laws.values())]), 0.08))
        ax.plot(first.t, goal, ":", color=DARK, label="reference", zorder=3)
    for k, ax in enumerate(inputs):
        ax.set_ylim(limits(torch.cat([x.u[run, :, k] for x in laws.values()]), 0.08))
    set_log_axis(error_panel, [control_errors(x)[run] for x in laws.values()])
    for index, (name, record) in enumerate(laws.items()):
        style = model_style(index)
        for k, ax in enumerate(coordinates):
            ax.plot(record.t, record.q[run, :, k], label=name, **style)
        for k, ax in enumerate(inputs):
            ax.plot(record.t, record.u[run, :, k], drawstyle="steps-post", **style)
        error_panel.plot(record.t, control_errors(record)[run], **style)
        if record.stopped[run] is not None:
            end = float(record.t[samples_before_stop(record, run) - 1])
            for ax in [*states, *inputs]:
                ax.axvline(end, color=style["color"], linestyle="--", linewidth=1.2)
    legend_below(figure)
    return figure


def controller_comparison_figure(
    records: Mapping[str, ClosedLoopRecord], *, title: str, label: str = ERROR
) -> Figure:
    """Draw the error over time of each law: mean and 10-90 % band of its complete runs."""
    errors = {
        name: (record.t, control_errors(record), stopped_runs(record))
        for name, record in records.items()
    }
    note = "mean over runs, 10–90 % band"
    return mean_error_figure(errors, {}, title=title, label=label, note=note, lost="stopped")


def tip_path_figure(
    t: Tensor, paths: Mapping[str, Tensor], reference: Tensor, *, title: str
) -> Figure:
    """Draw the path of the end effector in space, and its distance to the reference over time.

    The times t are ``(T,)`` in s, ``reference`` and the path of each law ``(T, 3)`` in m, NaN after
    a stop.
    """
    figure = Figure(figsize=(11, 5), layout="constrained")
    space, ax = figure.add_subplot(1, 2, 1, projection="3d"), figure.add_subplot(1, 2, 2)
    space.plot(*reference.T.numpy(), color=TRUTH, linewidth=5, label="reference")
    for index, (name, path) in enumerate(paths.items()):
        style = model_style(index) | {"linewidth": 1.3}
        space.plot(*path.T.numpy(), label=name, **style)
        ax.plot(t, 1e3 * (path - reference).norm(dim=-1), **style)
    space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", aspect="equal")
    space.locator_params(nbins=4)
    ax.set(xlabel="time [s]", ylabel="distance to the reference position [mm]")
    ax.set(xlim=(float(t[0]), float(t[-1])), ylim=(0, None))
    ax.grid(True, alpha=0.3)
    legend_below(figure)
    figure.suptitle(title)
    return figure
