"""What varied among runs, what it reached, and the figure of it."""

import math

import numpy as np
import pandas as pd
import pytest

from pinn_dyn.evaluation.sweep_figures import sweep_figure
from pinn_dyn.evaluation.sweep_table import (
    flatten,
    runs_table,
    sweep_table,
    sweep_text,
    told_apart,
    varied_parameters,
)


def test_a_head_is_told_by_its_class_and_a_swept_size_by_its_number():
    def config(head, width, lr):
        return flatten(
            {
                "model": {"damping": {"_target_": f"m.{head}", "width": width}},
                "optimizer": {"lr": lr},
            }
        )

    of_class = [config("Constant", None, 0.1), config("Network", 8, 0.1)]
    assert varied_parameters(of_class) == ["model.damping._target_"]
    assert of_class[0]["model.damping._target_"] == "Constant"
    of_both = [*of_class, config("Network", 16, 0.1)]
    assert varied_parameters(of_both) == ["model.damping._target_", "model.damping.width"]


def test_values_and_not_their_spelling_tell_runs_apart():
    assert varied_parameters([{"a": 10, "b": 1}, {"a": 10.0, "b": True}]) == ["b"]
    assert varied_parameters([{"a": 1}, {}]) == ["a"]


def test_a_section_that_is_derived_takes_its_keys_along():
    assert varied_parameters([{"a.b": 1, "c": 1}, {"a.b": 2, "c": 2}], derived={"a"}) == ["c"]


def test_what_the_model_alone_decides_is_not_shown():
    configs = [
        {"model_name": "lnn", "epochs": 5, "lr": 0.1},
        {"model_name": "lnn", "epochs": 5, "lr": 0.2},
        {"model_name": "mlp", "epochs": 9, "lr": 0.1},
    ]
    parameters = varied_parameters(configs)
    assert parameters == ["model_name", "epochs", "lr"]
    assert told_apart(parameters, configs) == ["model_name", "lr"]


@pytest.mark.filterwarnings("error")
def test_a_diverged_seed_makes_the_mean_infinite_and_never_nan():
    configs = [{"x": x, "seed": seed} for seed, x in enumerate([1, 1, 2])]
    errors = [{"val/error_mean": error} for error in (1.0, math.inf, 3.0)]
    runs = runs_table(["0", "1", "2"], configs, errors, ["x"])
    table = sweep_table(runs, ["x"], sort="val/error_mean")
    assert list(table["val/error_mean"]) == [3.0, math.inf]
    text = sweep_text(table, ["x"])
    assert "inf" in text
    assert "nan" not in text


def drawn(figure):
    """Label, places and means of each line, and the number of dots of single seeds."""
    (ax,) = figure.axes
    lines = {
        line.get_label(): dict(zip(line.get_xdata(), line.get_ydata(), strict=True))
        for line in ax.lines
        if not line.get_label().startswith("_")
    }
    dots = sum(len(line.get_xdata()) for line in ax.lines if line.get_label().startswith("_"))
    return ax, lines, dots


def figure_runs(x, errors):
    """Two models, two seeds."""
    return pd.DataFrame(
        [
            {"x": value, "model_name": model, "seed": seed, "error": scale * error * (1 + 2 * seed)}
            for model, scale in (("lnn", 1.0), ("mlp", 10.0))
            for value, error in zip(x, errors, strict=True)
            for seed in (0, 1)
        ]
    )


def test_lines_go_through_the_means_and_axes_that_span_decades_are_logarithmic():
    runs = figure_runs([1, 10, 100], [1.0, 0.5, 0.25])
    ax, lines, dots = drawn(sweep_figure(runs, x="x", lines=["model_name"], y="error"))
    assert lines == {
        "lnn": {1: 2.0, 10: 1.0, 100: 0.5},
        "mlp": {1: 20.0, 10: 10.0, 100: 5.0},
    }
    assert dots == len(runs)
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert [label.get_text() for label in ax.get_xticklabels()] == ["1", "10", "100"]
    (legend,) = ax.figure.legends
    assert legend.get_title().get_text() == "model_name"


def test_narrow_ranges_are_drawn_on_linear_axes_and_words_side_by_side():
    runs = figure_runs([1, 2], [1.0, 0.5])
    runs = runs[runs.model_name == "lnn"]
    ax, _, _ = drawn(sweep_figure(runs, x="x", lines=[], y="error"))
    assert (ax.get_xscale(), ax.get_yscale()) == ("linear", "linear")
    runs = figure_runs(["relu", "elu"], [1.0, 0.5])
    ax, lines, _ = drawn(sweep_figure(runs, x="x", lines=["model_name"], y="error"))
    assert [label.get_text() for label in ax.get_xticklabels()] == ["elu", "relu"]
    assert lines["lnn"] == {"elu": 1.0, "relu": 2.0}


def test_diverged_runs_are_counted_where_they_cannot_be_drawn():
    runs = figure_runs([1, 2], [1.0, 0.5])
    runs.loc[0, "error"] = np.inf
    ax, lines, _ = drawn(sweep_figure(runs, x="x", lines=["model_name"], y="error"))
    assert "1 diverged run is not drawn" in ax.get_title(loc="right")
    assert lines["lnn"][1] == 3.0


def test_lines_that_nobody_could_tell_apart_are_refused():
    runs = pd.DataFrame({"x": 1, "lr": range(13), "seed": 0, "error": 1.0})
    with pytest.raises(ValueError, match=r"13 lines.*filter"):
        sweep_figure(runs, x="x", lines=["lr"], y="error")
