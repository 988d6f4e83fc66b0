"""Figures of closed loops, drawn without a display or global state."""

from __future__ import annotations

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from pinn_dyn.control.record import ClosedLoopRecord
from pinn_dyn.evaluation.control_metrics import samples_before_stop, stopped_runs
from pinn_dyn.evaluation.figures import _COLOURS, _TRUTH, _limits, _names

_WARNING = "#D55E00"

# A peak of the input this many times above its 95th percentile gets a logarithmic axis.
_SPIKE = 20


def closed_loop_figure(
    record: ClosedLoopRecord,
    run: int,
    *,
    title: str,
    labels: list[str] | None = None,
    input_labels: list[str] | None = None,
) -> Figure:
    """One run: states over dotted references, errors q_ref - q, and inputs.

    Up to 6 coordinates and inputs share three panels, each with its colour; more get a row each.
    A run that was stopped has a line at that time, and the reason above; its last tenth, where it
    may run away, does not count for the range of the panels.

    Args:
        record: K runs.
        run: which of the K to draw.
        title: plant and controller.
        labels: name and unit of each coordinate; None takes q1 ... qN.
        input_labels: name and unit of each input; None takes u1 ... uM.

    Raises:
        ValueError: on labels that do not fit.
    """
    q, q_ref, u, t = record.q[run], record.reference.q[run], record.u[run], record.t
    labels = _names(labels, "q", q.shape[-1], "labels")
    input_labels = _names(input_labels, "u", u.shape[-1], "input_labels")
    rows = max(len(labels), len(input_labels))
    shared = rows <= len(_COLOURS)
    names = ("configuration q", r"error $q_{ref} - q$", "input u")
    if shared:
        figure = Figure(figsize=(8, 7.5), layout="constrained")
        grid = figure.subplots(3, 1, sharex=True, squeeze=False)
        panels = [[grid[row, 0]] * rows for row in range(3)]
        for ax, name in zip(grid[:, 0], names, strict=True):
            ax.set_ylabel(name)
    else:
        figure = Figure(figsize=(12, 1.35 * rows + 1.6), layout="constrained")
        grid = figure.subplots(rows, 3, sharex=True, squeeze=False)
        panels = [list(grid[:, column]) for column in range(3)]
        for ax, name in zip(grid[0], names, strict=True):
            ax.set_title(name, fontsize="medium")
    state_axes, error_axes, input_axes = panels
    for k, label in enumerate(labels):
        colour = _COLOURS[k] if shared else _COLOURS[0]
        reference = colour if shared else "black"
        state_axes[k].plot(t, q[:, k], color=colour, linewidth=1.4, label=label)
        state_axes[k].plot(t, q_ref[:, k], ":", color=reference, linewidth=1.6)
        error_axes[k].plot(t, q_ref[:, k] - q[:, k], color=colour, linewidth=1.2)
    for k, label in enumerate(input_labels):
        colour = _COLOURS[k] if shared else _COLOURS[0]
        # The input is held between two control instants.
        input_axes[k].plot(
            t, u[:, k], color=colour, linewidth=1.2, drawstyle="steps-post", label=label
        )
    for k in range(1 if shared else len(input_labels)):
        _make_room_for_spikes(input_axes[k], u if shared else u[:, k])
    for ax in dict.fromkeys(error_axes[: len(labels)]):
        ax.axhline(0, color="black", linestyle=":", linewidth=1)
    if shared:
        for ax in (grid[0, 0], grid[2, 0]):
            ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize="small")
    else:
        _label_grid(panels, labels, input_labels)
    reason = record.stopped[run]
    if reason is not None:
        end = samples_before_stop(record, run)
        calm = slice(0, 1 + int(0.9 * (end - 1)))
        # At the instant of a stop the law may have had no finite answer.
        inputs = u[calm].nan_to_num(0.0, 0.0, 0.0)
        signals = (torch.cat([q[calm], q_ref[:end]]), (q_ref - q)[calm], inputs)
        for axes, values in zip(panels, signals, strict=True):
            for k in range(values.shape[1]):
                axes[k].set_ylim(*_limits(values if shared else values[:, k]))
        for ax in grid.flat:
            ax.axvline(float(t[end - 1]), color="black", linestyle="--", linewidth=1.2)
        title += f"\nstopped: {reason}"
    for ax in grid[-1]:
        ax.set_xlabel("time (s)")
    grid[0, 0].set_xlim(float(t[0]), float(t[-1]))
    solid, dotted = (
        figure.axes[0].plot([], [], style, color="black", linewidth=1.4)[0] for style in ("-", ":")
    )
    if not shared:
        solid.set_color(_COLOURS[0])
    figure.legend([solid, dotted], ["reached", "reference"], loc="outside lower center", ncols=2)
    figure.suptitle(title)
    figure.align_ylabels(grid)
    return figure


def controller_comparison_figure(
    records: dict[str, ClosedLoopRecord],
    *,
    title: str,
    label: str = r"$\|q_{ref} - q\|_2$",
) -> Figure:
    """Error over time: per controller the mean over its runs and their 10-90 % band.

    Stopped runs are left out of both and counted in the legend.

    Args:
        records: controller names and their runs; the order of the names fixes their colours.
        title: plant and task.
        label: name and unit of the error.
    """
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    ax = figure.subplots()
    floors = []
    for index, (name, record) in enumerate(records.items()):
        colour = _COLOURS[index % len(_COLOURS)]
        lost = stopped_runs(record)
        total, count = len(lost), int(lost.sum())
        note = "" if count == 0 else f" ({count} of {total} stopped)"
        if count == total:
            ax.plot([], [], color=colour, label=name + note)
            continue
        error = (record.reference.q - record.q)[~lost].double().norm(dim=-1)
        low, high = torch.quantile(error, torch.tensor([0.1, 0.9], dtype=error.dtype), dim=0)
        mean = error.mean(dim=0)
        ax.plot(record.t, mean, color=colour, linewidth=1.5, label=name + note)
        ax.fill_between(record.t, low, high, color=colour, alpha=0.18, linewidth=0)
        floors.append(float(mean.median()))
    ax.set_yscale("log")
    # Tracking may start at no error at all: three decades below the best are enough of that.
    if floors and min(floors) > 0:
        ax.set_ylim(bottom=1e-3 * min(floors))
    ax.set_xlabel("time (s)")
    ax.set_ylabel(label)
    ax.grid(True, which="major", alpha=0.3)
    times = [record.t for record in records.values()]
    ax.set_xlim(min(float(t[0]) for t in times), max(float(t[-1]) for t in times))
    figure.legend(loc="outside lower center", ncols=3, title="mean over runs, 10-90 % band")
    figure.suptitle(title)
    return figure


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
    space.plot(*wanted.T.numpy(), color=_TRUTH, linewidth=5, label="wanted")
    for index, (name, path) in enumerate(paths.items()):
        colour = _COLOURS[index % len(_COLOURS)]
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
    bound: Tensor, measured: Tensor, *, title: str, label: str = r"$\|q_{ref} - q\|_2$"
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
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.scatter(x[~above], y[~above], s=28, color=_COLOURS[0], label="below its bound")
    if above.any():
        ax.scatter(x[above], y[above], s=40, color=_WARNING, marker="x", label="above its bound")
    if len(x):
        both = torch.cat([x, y])
        ends = (0.5 * float(both.min()), 2 * float(both.max()))
        ax.plot(ends, ends, "--", color="0.4", linewidth=1, label="error = bound")
        ax.set_xlim(ends)
        ax.set_ylim(ends)
    ax.set_aspect("equal")
    ax.grid(True, which="major", alpha=0.3)
    ax.set_xlabel(f"predicted bound on {label}")
    ax.set_ylabel(f"measured {label}")
    ax.legend(loc="upper left", fontsize="small")
    lines = [title, f"{int((~above).sum())} of {int(bounded.sum())} bounds hold"]
    unbounded, endless = int((~bounded).sum()), int((bounded & ~drawn).sum())
    if unbounded or endless:
        lines.append(f"not drawn: {unbounded} without a bound, {endless} without a finite error")
    figure.suptitle("\n".join(lines), fontsize="medium")
    return figure


def _make_room_for_spikes(ax: Axes, values: Tensor) -> None:
    """A logarithmic axis beyond the usual values where a spike would flatten these."""
    sizes = values.abs().nan_to_num(0.0, 0.0, 0.0).flatten()
    usual = float(torch.quantile(sizes, 0.95))
    if usual > 0 and float(sizes.max()) > _SPIKE * usual:
        ax.set_yscale("symlog", linthresh=usual)
        ax.set_ylabel(f"{ax.get_ylabel()}\nlogarithmic beyond ±{usual:.2g}")


def _label_grid(panels: list[list[Axes]], labels: list[str], input_labels: list[str]) -> None:
    """Names on the panels of a grid; panels that nothing is drawn in are hidden."""
    for column, names in zip(panels, (labels, None, input_labels), strict=True):
        for row, ax in enumerate(column):
            if row >= len(labels if names is None else names):
                ax.set_axis_off()
            elif names is not None:
                ax.set_ylabel(names[row], fontsize="small")
