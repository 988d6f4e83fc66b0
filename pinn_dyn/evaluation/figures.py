"""Figures of roll-outs and of learned terms, drawn without a display or global state."""

from __future__ import annotations

import itertools
from pathlib import Path

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from pinn_dyn.evaluation.learned_terms import TermComparison
from pinn_dyn.evaluation.metrics import diverged_trajectories
from pinn_dyn.evaluation.prediction import Prediction
from pinn_dyn.mechanics import Trajectory

# Okabe and Ito's palette, told apart by colour-blind readers; truth is grey.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_LINES = ("-", "--", ":", "-.")
_TRUTH = "0.70"
_MATH = {
    "M": "$M(q)$",
    "M_inverse": "$M^{-1}(q)$",
    "D": "$D(q)$",
    "G": "$G(q)$",
    "A": "$A(q)$",
}


def trajectory_figure(
    truth: Trajectory,
    predictions: dict[str, Prediction],
    *,
    trajectory: int,
    title: str,
    labels: list[str] | None = None,
    input_labels: list[str] | None = None,
) -> Figure:
    """One test trajectory: a panel per coordinate, truth and models, and the input below.

    The truth sets the range of each panel, so that a diverging model does not flatten the others;
    a note above the panel says when a model leaves it.

    Args:
        truth: K test trajectories stacked, q ``(K, T, N)``.
        predictions: model names and their roll-outs of the same K trajectories; the order of the
            names fixes their colours and lines.
        trajectory: which of the K to draw.
        title: data set and horizon.
        labels: name and unit of each coordinate; None takes q1 ... qN.
        input_labels: name and unit of each input; None takes u1 ... uM.
    """
    q, u, t = truth.q[trajectory], truth.u[trajectory], truth.t
    labels = _names(labels, "q", q.shape[-1], "labels")
    input_labels = _names(input_labels, "u", u.shape[-1], "input_labels")
    count = len(labels)
    figure = Figure(figsize=(8, 1.7 * count + 2.0), layout="constrained")
    axes = figure.subplots(count + 1, 1, sharex=True, height_ratios=[1.0] * count + [0.8])
    for k, label in enumerate(labels):
        ax = axes[k]
        ax.plot(t, q[:, k], color=_TRUTH, linewidth=5, label="truth", solid_capstyle="butt")
        low, high = _limits(q[:, k])
        notes = []
        for name, prediction, colour, line in _styled(predictions):
            q_hat = prediction.q_hat[trajectory, :, k]
            outside = ~((q_hat >= low) & (q_hat <= high))
            # Beyond the panel only the way out matters; huge numbers upset the renderer.
            drawn = q_hat.clamp(2 * low - high, 2 * high - low)
            ax.plot(prediction.t, drawn, line, color=colour, linewidth=1.3, label=name)
            if torch.isnan(q_hat).all():
                notes.append(f"{name} broke down, not drawn")
            elif outside.any():
                first = float(prediction.t[int(outside.int().argmax())])
                notes.append(f"{name} leaves the panel at {first:.3g} s")
        ax.set_ylim(low, high)
        ax.set_ylabel(label)
        # Above the panel, where no line can hide it.
        ax.set_title("\n".join(notes), loc="right", fontsize="small")
    input_axes = axes[count]
    held = "steps-post" if truth.input.interpolation == "hold" else "default"
    for k, label in enumerate(input_labels):
        shade = str(0.65 * k / max(len(input_labels) - 1, 1))
        line = _LINES[k % len(_LINES)]
        input_axes.plot(t, u[:, k], line, color=shade, linewidth=1, drawstyle=held, label=label)
    input_axes.set_ylabel("input")
    input_axes.set_xlabel("time (s)")
    input_axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize="small")
    axes[0].set_xlim(float(t[0]), float(t[-1]))
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=min(len(names), 4))
    figure.suptitle(title)
    figure.align_ylabels(axes)
    return figure


def error_figure(
    predictions: dict[str, Prediction], *, title: str, label: str = r"$\|\hat q - q\|_2$"
) -> Figure:
    """Error over time: per model the mean over its trajectories and their 10-90 % band.

    Diverged trajectories are left out of both and counted in the legend. The start is not drawn:
    its error is 0 by construction.

    Args:
        predictions: model names and their roll-outs; the order of the names fixes their colours.
        title: data set and horizon.
        label: name and unit of the error.
    """
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    ax = figure.subplots()
    floors = []
    for name, prediction, colour, line in _styled(predictions):
        lost = diverged_trajectories(prediction)
        total, count = lost.shape[0], int(lost.sum())
        note = "" if count == 0 else f" ({count} of {total} diverged)"
        t, error = prediction.t[1:], prediction.error()[~lost][:, 1:]
        if count == total:
            ax.plot([], [], line, color=colour, label=name + note)
            continue
        mean = error.mean(dim=0)
        low, high = torch.quantile(error, torch.tensor([0.1, 0.9], dtype=error.dtype), dim=0)
        ax.plot(t, mean, line, color=colour, linewidth=1.5, label=name + note)
        ax.fill_between(t, low, high, color=colour, alpha=0.18, linewidth=0)
        floors.append(float(mean.median()))
    ax.set_yscale("log")
    # The error starts from nothing: three decades below the best model are enough of that.
    if floors and min(floors) > 0:
        ax.set_ylim(bottom=1e-3 * min(floors))
    ax.set_xlabel("time (s)")
    ax.set_ylabel(label)
    ax.grid(True, which="major", alpha=0.3)
    times = [prediction.t for prediction in predictions.values()]
    ax.set_xlim(min(float(t[0]) for t in times), max(float(t[-1]) for t in times))
    figure.legend(
        loc="outside lower center", ncols=4, title="mean over test trajectories, 10-90 % band"
    )
    figure.suptitle(title)
    return figure


def spread_figure(prediction: Prediction, *, title: str) -> Figure:
    """Error of an ensemble beside the spread of its members, over time.

    Both are root mean squares over the trajectories that did not diverge; where the spread lies
    below the error, the ensemble is surer than it should be.

    Args:
        prediction: the roll-outs of an ensemble.
        title: data set, model and horizon.
    """
    kept = ~diverged_trajectories(prediction)
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    ax = figure.subplots()
    t = prediction.t[1:]
    lines = (
        ("error of the mean prediction", prediction.error(), _COLOURS[0], "-"),
        ("spread of the members", prediction.spread(), _COLOURS[1], "--"),
    )
    for name, values, colour, style in lines:
        if kept.any():
            mean = values[kept][:, 1:].square().mean(dim=0).sqrt()
            ax.plot(t, mean, style, color=colour, linewidth=1.5, label=name)
        else:
            ax.plot([], [], style, color=colour, label=f"{name} (all diverged)")
    ax.set_yscale("log")
    ax.set_xlabel("time (s)")
    ax.set_ylabel(r"root mean square of $\|\hat q - q\|_2$")
    ax.grid(True, which="major", alpha=0.3)
    ax.set_xlim(float(prediction.t[0]), float(prediction.t[-1]))
    figure.legend(loc="outside lower center", ncols=2)
    figure.suptitle(title)
    return figure


def terms_figure(
    comparison: TermComparison, *, configuration: int, title: str, inverse_mass: bool = False
) -> Figure:
    """M, D, G and A at one configuration: true X, learned X_L, and P X with the best-fit P.

    A model whose terms equal P X moves like the truth: multiplying the equation of motion by P
    does not change it. Each column has one colour scale, from minus to plus its largest entry; the
    colour follows the square root of an entry, so that small ones are not lost.

    Args:
        comparison: true and learned terms.
        configuration: which of the K configurations to draw.
        title: data set and model.
        inverse_mass: draw the inverse of M, which a Hamiltonian model learns, in place of M.
    """
    matrices = comparison.matrices()
    matrices.pop("M" if inverse_mass else "M_inverse")
    frame = comparison.to_frame()
    rows = comparison.q.shape[-1]
    widths = [max(pair[0].shape[-1], 1.6) for pair in matrices.values()]
    cell = 0.72 if rows <= 4 else 0.62
    figure = Figure(figsize=(cell * sum(widths) + 3.0, 3 * cell * rows + 2.6), layout="constrained")
    axes = figure.subplots(3, len(matrices), width_ratios=widths)
    for column, (term, three) in enumerate(matrices.items()):
        shown = [matrix[configuration] for matrix in three]
        scale = max(float(matrix.abs().max()) for matrix in shown) or 1.0
        for row, matrix in enumerate(shown):
            ax = axes[row, column]
            colour = matrix.sign() * (matrix.abs() / scale).sqrt()
            # The ends of the colour map are too dark to read a number on.
            ax.imshow(colour, cmap="RdBu_r", vmin=-1.6, vmax=1.6)
            _annotate(ax, matrix, digits=3 if rows <= 4 else 2)
        axes[0, column].set_title(_MATH[term])
        errors = frame[frame["term"] == term].iloc[configuration]
        axes[1, column].set_xlabel(f"error {_percent(errors['relative_error_identity'])}")
        axes[2, column].set_xlabel(f"misses {_percent(errors['relative_error_best_P'])}")
    for row, name in enumerate(("true X", "learned $X_L$", "P X, best P")):
        axes[row, 0].set_ylabel(name)
    numbers = ", ".join(f"{value:.4g}" for value in comparison.q[configuration].tolist())
    figure.suptitle(
        f"{title}\nq = ({numbers}), error $|X_L - X| / |X|$, P X misses $|X_L - P X| / |X_L|$"
    )
    return figure


def _percent(ratio: float) -> str:
    return f"{100 * ratio:.0f} %" if ratio > 0.1 else f"{100 * ratio:.2g} %"


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG at 150 dpi, and its folder if there is none."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="png", dpi=150)


def _styled(predictions: dict[str, Prediction]) -> list[tuple[str, Prediction, str, str]]:
    """Each model with a colour of its own; where the colours end, with another kind of line."""
    styles = itertools.cycle(itertools.product(_LINES, _COLOURS))
    return [
        (name, prediction, colour, line)
        for (name, prediction), (line, colour) in zip(predictions.items(), styles, strict=False)
    ]


def _names(given: list[str] | None, letter: str, count: int, argument: str) -> list[str]:
    names = given or [f"{letter}{k + 1}" for k in range(count)]
    if len(names) != count:
        raise ValueError(f"{argument} has {len(names)} entries, expected {count}: {names}")
    return names


def _limits(values: Tensor) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    margin = 0.3 * (high - low) or 0.1 * abs(high) or 1.0
    return low - margin, high + margin


def _annotate(ax: Axes, matrix: Tensor, digits: int) -> None:
    ax.set_xticks([])
    ax.set_yticks([])
    floor = 1e-6 * float(matrix.abs().max())
    for i, row in enumerate(matrix.tolist()):
        for j, value in enumerate(row):
            text = f"{value:.0f}" if 100 <= abs(value) < 1e5 else f"{value:.{digits}g}"
            if abs(value) <= floor:
                text = "0"
            ax.text(j, i, text, ha="center", va="center", fontsize="x-small")
