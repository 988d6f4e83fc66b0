"""Figures of roll-outs and of learned terms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from pinn_dyn.evaluation.drawing import (
    COLOURS,
    DARK,
    DASHES,
    GREY,
    TRUTH,
    Line,
    Panel,
    error_panel,
    look,
    names,
    with_unit,
)
from pinn_dyn.evaluation.learned_terms import TermComparison
from pinn_dyn.evaluation.metrics import diverged_trajectories
from pinn_dyn.evaluation.png import mean_png, motion_png
from pinn_dyn.evaluation.prediction import Prediction
from pinn_dyn.mechanics import Trajectory

ERROR = "‖q̂ − q‖₂"
_TERMS = {
    "M": "$M(q)$",
    "M_inverse": "$M^{-1}(q)$",
    "D": "$D(q)$",
    "G": "$G(q)$",
    "A": "$A(q)$",
}


def trajectory_panels(
    truth: Trajectory,
    predictions: Mapping[str, Prediction],
    labels: Sequence[str],
    input_labels: Sequence[str],
    floors: Mapping[str, Prediction] | None = None,
) -> tuple[list[Panel], list[Panel]]:
    """A panel per coordinate, truth and models, with the error below; and a panel per input.

    The truth sets the range of each panel, so that a diverging model does not flatten the others.

    Args:
        truth: K trajectories stacked, q ``(K, T, N)``.
        predictions: model names and their roll-outs of the same K trajectories; the order of the
            names fixes their colours and dashes.
        labels, input_labels: name and unit of each coordinate and input.
        floors: what the models have to beat, in thin grey lines.
    """
    styled = [(name, item, *look(k), 1.3) for k, (name, item) in enumerate(predictions.items())]
    styled += [(name, item, GREY, "dash", 1.0) for name, item in (floors or {}).items()]
    states = []
    for k, label in enumerate(labels):
        real = Line("truth", truth.t, truth.q[..., k], TRUTH, width=4, always=True)
        guesses = [
            Line(name, item.t, item.q_hat[..., k], colour, dash, width)
            for name, item, colour, dash, width in styled
        ]
        states.append(Panel(label, [real, *guesses], leading=real))
    distances = [
        Line(name, item.t, item.error(), colour, dash, width)
        for name, item, colour, dash, width in styled
    ]
    states.append(Panel(with_unit(ERROR, labels), distances, log=True))
    held = truth.input.interpolation == "hold"
    inputs = [
        Panel(
            label,
            [Line("input", truth.t, truth.u[..., k], DARK, width=1.2, held=held, always=True)],
        )
        for k, label in enumerate(input_labels)
    ]
    return states, inputs


def trajectory_figure(
    truth: Trajectory,
    predictions: Mapping[str, Prediction],
    *,
    trajectory: int,
    title: str,
    labels: Sequence[str] | None = None,
    input_labels: Sequence[str] | None = None,
    floors: Mapping[str, Prediction] | None = None,
) -> Figure:
    """One test trajectory, see :func:`trajectory_panels`; a note says when a model leaves a panel.

    Args:
        truth, predictions: K trajectories and roll-outs of them.
        trajectory: which of the K to draw.
        title: data set and horizon.
        labels: name and unit of each coordinate; None takes q1 ... qN.
        input_labels: name and unit of each input; None takes u1 ... uM.
        floors: what the models have to beat, in thin grey lines.

    Raises:
        ValueError: on labels that do not fit.
    """
    labels = names(labels, "q", truth.q.shape[-1], "labels")
    inputs = names(input_labels, "u", truth.u.shape[-1], "input_labels")
    columns = trajectory_panels(truth, predictions, labels, inputs, floors)
    return motion_png(columns, trajectory, title=title)


def prediction_errors(
    predictions: Mapping[str, Prediction],
    floors: Mapping[str, Prediction] | None = None,
    label: str = ERROR,
) -> Panel:
    """Errors of models over time, and of the floors that they have to beat in grey."""
    models, below = (
        {name: (p.t, p.error(), diverged_trajectories(p)) for name, p in (found or {}).items()}
        for found in (predictions, floors)
    )
    return error_panel(models, floors=below, label=label)


def error_figure(
    predictions: Mapping[str, Prediction],
    *,
    title: str,
    floors: Mapping[str, Prediction] | None = None,
    label: str = ERROR,
) -> Figure:
    """Error over time: per model the mean over its trajectories and their 10-90 % band.

    Diverged trajectories are left out of both and counted in the legend.

    Args:
        predictions: model names and their roll-outs; the order of the names fixes their colours.
        title: data set and horizon.
        floors: what the models have to beat, in thin grey lines.
        label: name and unit of the error.
    """
    panel = prediction_errors(predictions, floors, label)
    grey = "; grey: what to beat" if floors else ""
    note = f"mean over test trajectories, 10–90 % band{grey}"
    return mean_png(panel, title=title, note=note, lost="diverged")


def spread_figure(prediction: Prediction, *, title: str) -> Figure:
    """Error of an ensemble beside the spread of its members, over time.

    Both are root mean squares over the trajectories that did not diverge; where the spread lies
    below the error, the ensemble is surer than it should be.

    Args:
        prediction: the roll-outs of an ensemble.
        title: data set, model and horizon.
    """
    kept = ~diverged_trajectories(prediction)
    lost = (~kept).all()[None]
    lines = []
    for index, (name, values) in enumerate(
        [
            ("error of the mean prediction", prediction.error()),
            ("spread of the members", prediction.spread()),
        ]
    ):
        mean = values[kept][:, 1:].square().mean(dim=0, keepdim=True).sqrt()
        style = COLOURS[index], DASHES[index]
        lines.append(Line(name, prediction.t[1:], mean, *style, lost=lost, band=False))
    panel = Panel(f"root mean square of {ERROR}", lines, log=True)
    note = "over the trajectories that did not diverge"
    return mean_png(panel, title=title, note=note, lost="diverged")


def terms_figure(comparison: TermComparison, *, configuration: int, title: str) -> Figure:
    """M, D, G and A at one configuration: true X, learned X_L, and P X with the best-fit P.

    In place of M its inverse, where the equations of the model are in that.

    A model whose terms equal P X moves like the truth: multiplying the equation of motion by P
    does not change it. The three of a term have one colour scale, from minus to plus their largest
    entry; the colour follows the square root of an entry, so that small ones are not lost.

    Args:
        comparison: true and learned terms.
        configuration: which of the K configurations to draw.
        title: data set and model.
    """
    matrices = comparison.matrices()
    matrices.pop("M" if comparison.of_inverse_mass else "M_inverse")
    errors = comparison.to_frame().set_index("term")
    rows = comparison.q.shape[-1]
    widths = [max(three[0].shape[-1], 1.6) for three in matrices.values()]
    cell = 0.72 if rows <= 4 else 0.62
    figure = Figure(figsize=(cell * sum(widths) + 3.0, 3 * cell * rows + 2.6), layout="constrained")
    axes = figure.subplots(3, len(matrices), width_ratios=widths)
    for column, (term, three) in enumerate(matrices.items()):
        shown = [matrix[configuration] for matrix in three]
        scale = max(float(x.where(x.isfinite(), 0.0).abs().max()) for x in shown) or 1.0
        for ax, matrix in zip(axes[:, column], shown, strict=True):
            colour = (matrix.sign() * (matrix.abs() / scale).sqrt()).clamp(-1, 1)
            # The ends of the colour map are too dark to read a number on.
            ax.imshow(colour, cmap="RdBu_r", vmin=-1.6, vmax=1.6)
            _annotate(ax, matrix, digits=3 if rows <= 4 else 2)
        axes[0, column].set_title(_TERMS[term])
        error = errors.loc[[term]].iloc[configuration]
        axes[1, column].set_xlabel(f"error {_percent(error['relative_error_identity'])}")
        axes[2, column].set_xlabel(f"misses {_percent(error['relative_error_best_P'])}")
    for row, kind in enumerate(("true X", "learned $X_L$", "P X, best P")):
        axes[row, 0].set_ylabel(kind)
    numbers = ", ".join(f"{value:.4g}" for value in comparison.q[configuration].tolist())
    figure.suptitle(
        f"{title}\nq = ({numbers}), error $|X_L - X| / |X|$, P X misses $|X_L - P X| / |X_L|$"
    )
    return figure


def _percent(ratio: float) -> str:
    return f"{100 * ratio:.0f} %" if ratio > 0.1 else f"{100 * ratio:.2g} %"


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
