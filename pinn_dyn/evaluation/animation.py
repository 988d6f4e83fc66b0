"""Moving pictures of closed loops as GIFs, and a strip of poses, drawn without a display."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from PIL import Image, ImageDraw
from torch import Tensor

from pinn_dyn.control.record import ClosedLoopRecord
from pinn_dyn.evaluation.control_metrics import samples_before_stop
from pinn_dyn.evaluation.plots import COLORS, TRUTH
from pinn_dyn.systems import Drawable, Rendered

_TIP = "#CC0000"
_FRAME = 40  # ms, and of pictures, which take long to render, 50; a GIF counts in 10 ms
_PICTURE, _SIZE = 50, (480, 360)  # px
_LAST_FRAME = 1000  # ms


def animate(record: ClosedLoopRecord, run: int, robot: object, path: Path) -> None:
    """Write a GIF of a robot that can be drawn; of any other there is none."""
    if isinstance(robot, Rendered):
        animate_pictures(record, run, robot, path)
    elif isinstance(robot, Drawable):
        animate_lines(record, run, robot, path)


def animate_lines(record: ClosedLoopRecord, run: int, robot: Drawable, path: Path) -> None:
    """Write a GIF of a robot's lines in motion, in real time, with the path of its tip in red.

    The wanted shape is in grey.

    Args:
        record: K runs.
        run: which of the K to draw; a stopped one is drawn up to its stop.
        robot: what gives the lines of q.
        path: the GIF; its folder is made if there is none.
    """
    samples = _frames(record, run, _FRAME)
    shape, wanted = _shapes(record, run, robot)
    scene = _scene(record, run, shape, wanted)
    figure = Figure(figsize=(4.8, 4.8), dpi=90)
    canvas = FigureCanvasAgg(figure)
    ax = figure.add_axes((0.0, 0.07, 0.95, 0.88), projection="3d")
    _set_space(ax, scene, robot.z_is_down)
    images: list[Image.Image] = []
    for sample in samples:
        for line in list(ax.lines):
            line.remove()
        _draw_pose(ax, shape, wanted, sample)
        text = _time_text(record, run, sample, last=sample == samples[-1])
        figure.suptitle(text, x=0.03, y=0.98, ha="left", fontsize="medium", family="monospace")
        if not images:
            _legend(figure, ax)
        canvas.draw()
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    _save_gif(images, path, _FRAME)


def pose_strip(
    record: ClosedLoopRecord, run: int, robot: Drawable, times: list[float], *, title: str
) -> Figure:
    """Poses side by side: the robot, the wanted pose in grey, the path of the tip so far in red.

    Args:
        record: K runs.
        run: which of the K to draw.
        robot: what gives the lines of q.
        times: when, s, on the clock of the record; the nearest sample is drawn.
        title: plant and controller.

    Raises:
        ValueError: on no times, or times outside the run, which ends where it was stopped.
    """
    shape, wanted = _shapes(record, run, robot)
    t = record.t[: len(shape)]
    first, last = float(t[0]), float(t[-1])
    slack = 1e-9 * (1 + last - first)
    if not times or min(times) < first - slack or max(times) > last + slack:
        raise ValueError(
            f"times is {times}, expected some between {first:g} and {last:g} s, where run {run} "
            "begins and ends"
        )
    figure = Figure(figsize=(2.7 * len(times), 3.9))
    axes = figure.subplots(1, len(times), subplot_kw={"projection": "3d"}, squeeze=False)[0]
    scene = _scene(record, run, shape, wanted)
    for ax, time in zip(axes, times, strict=True):
        _set_space(ax, scene, robot.z_is_down)
        _draw_pose(ax, shape, wanted, int((t - time).abs().argmin()))
        ax.set_title(f"{time:g} s", y=1.0)
    _legend(figure, axes[0])
    figure.suptitle(title)
    figure.subplots_adjust(left=0.0, right=0.98, bottom=0.12, top=0.86, wspace=0.05)
    return figure


def animate_pictures(record: ClosedLoopRecord, run: int, robot: Rendered, path: Path) -> None:
    """Write a GIF of the pictures that a robot's simulator takes of its motion, in real time.

    The path of the tip in red and the wanted one in grey are in front of the robot.

    Args:
        record: K runs.
        run: which of the K to draw; a stopped one is drawn up to its stop.
        robot: what takes the pictures.
        path: the GIF; its folder is made if there is none.
    """
    samples = _frames(record, run, _PICTURE)
    q, q_ref = (x[run, samples].double() for x in (record.q, record.reference.q))
    points = torch.cat([robot.tip_position(q), robot.tip_position(q_ref)]).numpy()
    pictures, places = robot.render(q.numpy(), points, _SIZE)
    shown, goal = (list(map(tuple, part.tolist())) for part in np.split(places, 2))
    images = []
    for frame, (sample, picture) in enumerate(zip(samples, pictures, strict=True)):
        image = Image.fromarray(picture)
        draw = ImageDraw.Draw(image)
        draw.line(goal, fill="#707070", width=1)
        draw.line(shown[: frame + 1], fill=_TIP, width=2)
        draw.circle(goal[frame], 3, outline="black")
        draw.circle(shown[frame], 3, fill=_TIP)
        key = "path of the tip: red, wanted: grey"
        draw.text((8, _SIZE[1] - 20), key, fill="black", font_size=12)
        text = _time_text(record, run, sample, last=frame == len(samples) - 1)
        draw.text((8, 6), text, fill="black", font_size=14)
        images.append(image)
    _save_gif(images, path, _PICTURE)


def _frames(record: ClosedLoopRecord, run: int, duration: int) -> list[int]:
    """Samples to draw, a frame each ``duration`` ms, the last one before a stop included."""
    t = record.t[: samples_before_stop(record, run)].double()
    times = torch.arange(float(t[0]), float(t[-1]), 1e-3 * duration, dtype=t.dtype)
    samples = (t - times[:, None]).abs().argmin(dim=1).tolist()
    return [*dict.fromkeys([*samples, len(t) - 1])]


def _time_text(record: ClosedLoopRecord, run: int, sample: int, *, last: bool) -> str:
    reason = record.stopped[run]
    note = f"\nstopped: {reason}" if last and reason else ""
    return f"t = {float(record.t[sample]):.2f} s{note}"


def _save_gif(images: list[Image.Image], path: Path, duration: int) -> None:
    """The last frame, which has all the colours, gives the palette, and stays for a second."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    palette = images[-1].quantize(64)
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    times = [duration] * (len(frames) - 1) + [_LAST_FRAME]
    frames[0].save(
        path, format="GIF", save_all=True, append_images=frames[1:], duration=times, loop=0
    )


def _shapes(record: ClosedLoopRecord, run: int, robot: Drawable) -> tuple[Tensor, Tensor]:
    """Lines reached and wanted, ``(T, S, P, 3)`` each, up to the stop."""
    end = samples_before_stop(record, run)
    q, q_ref = record.q[run, :end], record.reference.q[run, :end]
    return robot.lines(q.double()), robot.lines(q_ref.double())


def _scene(record: ClosedLoopRecord, run: int, shape: Tensor, wanted: Tensor) -> Tensor:
    """All points ``(P, 3)`` to be seen; of a stopped run not the last tenth, it may run away."""
    end = len(shape) if record.stopped[run] is None else 1 + int(0.9 * (len(shape) - 1))
    return torch.cat([shape[:end].reshape(-1, 3), shape.new_zeros(1, 3), wanted.reshape(-1, 3)])


def _set_space(ax: Axes3D, points: Tensor, z_is_down: bool) -> None:
    """Equal scales around points ``(P, 3)``, gravity downwards."""
    low, high = points.amin(dim=0), points.amax(dim=0)
    size = (1.1 * (high - low)).clamp(min=0.5 * float((high - low).max()))
    middle = 0.5 * (low + high)
    (x0, y0, z0), (x1, y1, z1) = (middle - size / 2).tolist(), (middle + size / 2).tolist()
    ax.set(xlim=(x0, x1), ylim=(y0, y1), zlim=(z1, z0) if z_is_down else (z0, z1))
    ax.set_box_aspect(size.tolist(), zoom=0.82)
    for axis, name in ((ax.xaxis, "x (m)"), (ax.yaxis, "y (m)"), (ax.zaxis, "z (m)")):
        axis.set_label_text(name, fontsize="small")
        axis.labelpad = 5 if axis is ax.zaxis else -2
    ax.tick_params(labelsize="x-small", pad=0)
    ax.locator_params(nbins=3)
    ax.view_init(elev=15, azim=-60)


def _legend(figure: Figure, ax: Axes3D) -> None:
    handles, names = ax.get_legend_handles_labels()
    figure.legend(handles, names, loc="lower center", ncols=len(names), fontsize="small")


def _draw_pose(ax: Axes3D, shape: Tensor, wanted: Tensor, sample: int) -> None:
    ax.plot(*wanted[sample].flatten(0, 1).T.numpy(), color=TRUTH, linewidth=7, label="reference")
    for index, segment in enumerate(shape[sample]):
        colour = COLORS[(0, 5)[index % 2]]
        name = "arm" if index == 0 else None
        ax.plot(*segment.T.numpy(), color=colour, linewidth=4, solid_capstyle="butt", label=name)
    ax.plot([0], [0], [0], "s", color="black", markersize=7)
    tip = shape[: sample + 1, -1, -1].T.numpy()
    ax.plot(*tip, color=_TIP, linewidth=1.5, label="path of the tip")
    ax.plot(*tip[:, -1:], "o", color=_TIP, markersize=4)
