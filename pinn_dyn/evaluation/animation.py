"""Animations of closed loops as GIF, drawn without a display."""

from __future__ import annotations

from pathlib import Path

import torch
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from torch import Tensor

from pinn_dyn.control.closed_loop import ClosedLoopRecord
from pinn_dyn.evaluation.control_metrics import samples_before_stop
from pinn_dyn.plots import COLORS, TRUTH
from pinn_dyn.systems import Drawable

_TIP = "#CC0000"
_FRAMES_PER_SECOND = 20


def animate(record: ClosedLoopRecord, run: int, robot: Drawable, path: Path) -> None:
    """Write a GIF of one run in real time, up to its end or stop, which is shown for a second.

    The reference is grey, the path of the tip red. ``run`` is an index of the K runs.
    """
    end = samples_before_stop(record, run)
    shape, goal = (robot.lines(q[run, :end].double()) for q in (record.q, record.reference.q))
    t = record.t[:end].double()
    times = torch.arange(float(t[0]), float(t[-1]), 1 / _FRAMES_PER_SECOND, dtype=t.dtype)
    last = end - 1
    samples = [*(t - times[:, None]).abs().argmin(dim=1).tolist(), *[last] * _FRAMES_PER_SECOND]
    figure = Figure(figsize=(4.8, 4.8), dpi=90)
    ax = figure.add_axes((0.0, 0.07, 0.95, 0.88), projection="3d")
    # A stopped run may run away in its last tenth.
    visible = end if record.stopped[run] is None else 1 + int(0.9 * last)
    points = [shape[:visible].reshape(-1, 3), shape.new_zeros(1, 3), goal.reshape(-1, 3)]
    _set_space(ax, torch.cat(points), robot.z_is_down)

    def draw(sample: int) -> None:
        for line in list(ax.lines):
            line.remove()
        _draw_pose(ax, shape, goal, sample)
        text = f"t = {float(t[sample]):.2f} s"
        if sample == last and record.stopped[run]:
            text += f"\nstopped: {record.stopped[run]}"
        figure.suptitle(text, x=0.03, y=0.98, ha="left", fontsize="medium", family="monospace")

    draw(0)
    handles, names = ax.get_legend_handles_labels()
    figure.legend(handles, names, loc="lower center", ncols=len(names), fontsize="small")
    from matplotlib.animation import FuncAnimation, PillowWriter  # takes half a second

    FuncAnimation(figure, draw, samples).save(path, PillowWriter(_FRAMES_PER_SECOND))


def _set_space(ax: Axes3D, points: Tensor, z_is_down: bool) -> None:
    """Set equal scales around points ``(P, 3)``, with gravity pointing downwards."""
    low, high = points.amin(dim=0), points.amax(dim=0)
    size = (1.1 * (high - low)).clamp(min=0.5 * float((high - low).max()))
    middle = 0.5 * (low + high)
    (x0, y0, z0), (x1, y1, z1) = (middle - size / 2).tolist(), (middle + size / 2).tolist()
    ax.set(xlim=(x0, x1), ylim=(y0, y1), zlim=(z1, z0) if z_is_down else (z0, z1))
    ax.set_box_aspect(size.tolist(), zoom=0.82)
    for axis, name in ((ax.xaxis, "x [m]"), (ax.yaxis, "y [m]"), (ax.zaxis, "z [m]")):
        axis.set_label_text(name, fontsize="small")
        axis.labelpad = 5 if axis is ax.zaxis else -2
    ax.tick_params(labelsize="x-small", pad=0)
    ax.locator_params(nbins=3)
    ax.view_init(elev=15, azim=-60)


def _draw_pose(ax: Axes3D, shape: Tensor, goal: Tensor, sample: int) -> None:
    ax.plot(*goal[sample].flatten(0, 1).T.numpy(), color=TRUTH, linewidth=7, label="reference")
    for index, segment in enumerate(shape[sample]):
        color = COLORS[(0, 5)[index % 2]]
        name = "arm" if index == 0 else None
        ax.plot(*segment.T.numpy(), color=color, linewidth=4, solid_capstyle="butt", label=name)
    ax.plot([0], [0], [0], "s", color="black", markersize=7)
    tip = shape[: sample + 1, -1, -1].T.numpy()
    ax.plot(*tip, color=_TIP, linewidth=1.5, label="path of the tip")
    ax.plot(*tip[:, -1:], "o", color=_TIP, markersize=4)
