"""Figures of rollouts and of learned terms."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from pinn_dyn.evaluation.calibration import Calibration
from pinn_dyn.evaluation.learned_terms import TermComparison
from pinn_dyn.evaluation.metrics import diverged_trajectories
from pinn_dyn.evaluation.prediction import Prediction
from pinn_dyn.evaluation.tables import number, with_unit
from pinn_dyn.mechanics import Trajectory
from pinn_dyn.models.modes import Modes
from pinn_dyn.plots import (
    DARK,
    TRUTH,
    baseline_style,
    default_labels,
    legend_below,
    limits,
    mean_error_figure,
    model_style,
    panels,
    set_log_axis,
)

ERROR = "‖q̂ − q‖₂"
_TERMS = {"M": "$M(q)$", "M_inverse": "$M^{-1}(q)$", "D": "$D(q)$", "G": "$G(q)$", "A": "$A(q)$"}
_SHAPES = 6  # number of modes whose shapes are drawn
_SMALLEST_SHARE = 0.02  # of a mode that is drawn


def trajectory_figure(
    truth: Trajectory,
    predictions: Mapping[str, Prediction],
    *,
    trajectory: int,
    title: str,
    labels: Sequence[str] | None = None,
    input_labels: Sequence[str] | None = None,
    baselines: Mapping[str, Prediction] | None = None,
) -> Figure:
    """Draw one test trajectory: true and predicted configuration, the error, and the input.

    The truth sets the range of each panel, so that a diverged model does not flatten the others.

    Args:
        truth: K trajectories stacked, q ``(K, T, N)``.
        predictions: model names and their rollouts; the order of the names fixes their colors.
        trajectory: index of the trajectory.
        labels, input_labels: names and units of q and u; None takes q1 ... qN and u1 ... uM.
        baselines: names and rollouts of baselines, in grey.
    """
    labels = default_labels(labels, "q", truth.q.shape[-1])
    input_labels = default_labels(input_labels, "u", truth.u.shape[-1])
    columns = [[*labels, with_unit(ERROR, labels)], input_labels]
    figure, (states, inputs) = panels(columns, truth.t, title=title)
    curves = [(name, x, model_style(k)) for k, (name, x) in enumerate(predictions.items())]
    curves += [(n, x, baseline_style(k + 1)) for k, (n, x) in enumerate((baselines or {}).items())]
    *coordinates, error_panel = states
    for k, ax in enumerate(coordinates):
        q = truth.q[trajectory, :, k]
        ax.plot(truth.t, q, color=TRUTH, linewidth=4, label="truth")
        low, high = limits(q)
        ax.set_ylim(low, high)
        for name, item, style in curves:
            lost = " (diverged)" if diverged_trajectories(item)[trajectory] else ""
            # Huge values outside the panel upset the renderer.
            q_hat = item.q_hat[trajectory, :, k].clamp(2 * low - high, 2 * high - low)
            ax.plot(item.t, q_hat, label=name + lost, **{"linewidth": 1.3} | style)
    for _, item, style in curves:
        error_panel.plot(item.t, item.error()[trajectory], **{"linewidth": 1.3} | style)
    set_log_axis(error_panel, [item.error()[trajectory] for _, item, _ in curves])
    held = truth.input.interpolation == "hold"
    for k, ax in enumerate(inputs):
        drawstyle = "steps-post" if held else "default"
        ax.plot(truth.t, truth.u[trajectory, :, k], color=DARK, linewidth=1.2, drawstyle=drawstyle)
        ax.set_ylim(limits(truth.u[trajectory, :, k], margin=0.08))
    legend_below(figure)
    return figure


def error_figure(
    predictions: Mapping[str, Prediction],
    *,
    title: str,
    baselines: Mapping[str, Prediction] | None = None,
    label: str = ERROR,
) -> Figure:
    """Draw the configuration error over time: mean and 10-90 % band over the trajectories.

    Diverged trajectories are left out and counted in the legend. The arguments are those of
    :func:`trajectory_figure`, and the name and unit of the error as ``label``.
    """
    note = "mean over test trajectories, 10–90 % band" + ("; grey: baselines" if baselines else "")
    models, grey = (
        {name: (x.t, x.error(), diverged_trajectories(x)) for name, x in items.items()}
        for items in (predictions, baselines or {})
    )
    return mean_error_figure(models, grey, title=title, label=label, note=note, lost="diverged")


def terms_figure(comparison: TermComparison, *, configuration: int, title: str) -> Figure:
    """Draw M, D, G and A at one configuration: true X, learned X_L, and P X with the best-fit P.

    The inverse of M replaces M where the model's equations contain the inverse. The three matrices
    of a term share one color scale. The color follows the square root of an entry.
    """
    matrices = comparison.matrices()
    matrices.pop("M" if comparison.of_inverse_mass else "M_inverse")
    errors = comparison.to_frame().set_index("term")
    rows = comparison.q.shape[-1]
    widths = [max(true.shape[-1], 1.6) for true, _, _ in matrices.values()]
    cell = 0.72 if rows <= 4 else 0.62
    figure = Figure(figsize=(cell * sum(widths) + 3.0, 3 * cell * rows + 2.6), layout="constrained")
    axes = figure.subplots(3, len(matrices), width_ratios=widths)
    for column, (term, versions) in enumerate(matrices.items()):
        shown = [matrix[configuration] for matrix in versions]
        scale = max(float(x.where(x.isfinite(), 0.0).abs().max()) for x in shown) or 1.0
        for ax, matrix in zip(axes[:, column], shown, strict=True):
            shade = (matrix.sign() * (matrix.abs() / scale).sqrt()).clamp(-1, 1)
            # The ends of the color map are too dark to read a number on.
            ax.imshow(shade, cmap="RdBu_r", vmin=-1.6, vmax=1.6)
            _annotate(ax, matrix, digits=3 if rows <= 4 else 2)
        axes[0, column].set_title(_TERMS[term])
        error = errors.loc[[term]].iloc[configuration]
        axes[1, column].set_xlabel(f"error {number(100 * error['relative_error_identity'])} %")
        axes[2, column].set_xlabel(f"error {number(100 * error['relative_error_best_P'])} %")
    for row, kind in enumerate(("true X", "learned $X_L$", "P X, best P")):
        axes[row, 0].set_ylabel(kind)
    numbers = ", ".join(f"{value:.4g}" for value in comparison.q[configuration].tolist())
    figure.suptitle(
        f"{title}\nq = ({numbers}), error of $X_L$: $|X_L - X| / |X|$, "
        "error of $P X$: $|X_L - P X| / |X_L|$"
    )
    return figure


def _annotate(ax: Axes, matrix: Tensor, digits: int) -> None:
    ax.set(xticks=[], yticks=[])
    smallest = 1e-6 * float(matrix.abs().max())
    for i, row in enumerate(matrix.tolist()):
        for j, value in enumerate(row):
            text = f"{value:.0f}" if 100 <= abs(value) < 1e5 else f"{value:.{digits}g}"
            text = text if abs(value) > smallest else "0"
            ax.text(j, i, text, ha="center", va="center", fontsize="x-small")


def modes_figure(modes: Modes, *, title: str, labels: Sequence[str]) -> Figure:
    """Draw eigenfrequencies and damping ratios, and the shapes of the strongest modes.

    The area of a dot grows with the share of its mode. Numbers are those of the table of modes. A
    shape is relative to the spread of each coordinate in the training data.
    """
    figure = Figure(figsize=(10.5, 4.8), layout="constrained")
    plane, shapes = figure.subplots(1, 2, width_ratios=[1.3, 1])
    shown = modes.share > _SMALLEST_SHARE
    frequency, damping, share = (
        x[shown].numpy() for x in (modes.frequency, modes.damping, modes.share)
    )
    color = model_style(0)["color"]
    plane.scatter(frequency, damping, s=20 + 300 * share, color=color, alpha=0.45)
    strongest = range(min(_SHAPES, len(frequency)))
    for k in strongest:
        plane.annotate(str(k + 1), (frequency[k], damping[k]), ha="center", va="center")
    plane.set(xscale="log", xlabel="eigenfrequency [Hz]", ylabel="damping ratio", ylim=(0, 1.08))
    for formatted in (plane.xaxis.set_major_formatter, plane.xaxis.set_minor_formatter):
        formatted("{x:g}")
    plane.set_title("area: share in the motion, the largest is 1", fontsize="medium")
    plane.grid(True, alpha=0.3)
    values = modes.relative_shapes[: len(strongest)]
    shapes.imshow(values, cmap="RdBu_r", vmin=-1.6, vmax=1.6, aspect="auto")
    for i, row in enumerate(values.tolist()):
        for j, value in enumerate(row):
            shapes.text(
                j, i, f"{round(value, 2) + 0.0:.2f}", ha="center", va="center", fontsize="small"
            )
    names = [f"{k + 1}: {frequency[k]:.3g} Hz, ζ {damping[k]:.2f}" for k in strongest]
    shapes.set_xticks(range(len(labels)), labels)
    shapes.set_yticks(strongest, names)
    shapes.set_title("shapes, in standard deviations of q", fontsize="medium")
    figure.suptitle(title)
    return figure


def sweep_figure(runs: pd.DataFrame, *, x: str, lines: Sequence[str], y: str) -> Figure:
    """Draw an error y against a setting x: a dot for each run, a line through the means over seeds.

    All three name columns of ``runs``. Combinations of the columns ``lines`` are separate lines.
    Diverged runs with an infinite error are not drawn; the legend counts them.
    """
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    ax = figure.subplots()
    numeric = pd.api.types.is_numeric_dtype(runs[x])
    runs = runs.assign(**{x: runs[x] if numeric else runs[x].map(str)}).sort_values(x)
    groups = runs.groupby(list(lines) or (lambda _: 0), sort=False, dropna=False)
    for index, (key, rows) in enumerate(groups):
        finite = rows[rows[y].abs() < math.inf]
        name = ", ".join(map(str, key)) if lines else y
        if len(finite) < len(rows):
            name += f" ({len(rows) - len(finite)} of {len(rows)} diverged)"
        style = model_style(index)
        ax.plot(finite.groupby(x, sort=False)[y].mean(), marker="o", label=name, **style)
        ax.plot(finite[x], finite[y], ".", color=style["color"], alpha=0.4)
    ax.set(xlabel=x, ylabel=y)
    ax.set_yscale("log")
    if numeric and runs[x].min() > 0 and runs[x].max() > 10 * runs[x].min():
        ax.set_xscale("log")
    ax.grid(True, alpha=0.3)
    legend_below(figure, title=", ".join(lines) or None, fontsize="small")
    return figure


def calibration_figure(runs: Mapping[str, Mapping[float, Calibration]], *, title: str) -> Figure:
    """Draw the coverage of intervals over their nominal level, for the longest window of each run.

    An interval on the diagonal has the nominal coverage; below the diagonal it is too narrow.
    """
    figure = Figure(figsize=(6.0, 4.4 + 0.25 * len(runs)), layout="constrained")
    ax = figure.subplots()
    ax.plot([0, 100], [0, 100], color="black", linewidth=0.8, label="nominal")
    for index, (run, items) in enumerate(runs.items()):
        window, color = max(items), model_style(index)["color"]
        item, label = items[window], f"{run}, reset every {window:g} s"
        ax.plot(100 * item.level, 100 * item.share, "o-", color=color, markersize=4, label=label)
        if item.corrected is not None:
            label = f"{run}, width from validation"
            ax.plot(100 * item.level, 100 * item.corrected, "--", color=color, label=label)
    ax.set(xlabel="nominal level [%]", xlim=(0, 100), ylim=(0, 101))
    ax.set_ylabel("errors within the interval [%]")
    ax.grid(True, alpha=0.3)
    legend_below(figure, columns=1, fontsize="small")
    figure.suptitle(title)
    return figure
