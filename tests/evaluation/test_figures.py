from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from pinn_dyn.evaluation import (
    Prediction,
    compare_terms,
    error_figure,
    save,
    spread_figure,
    terms_figure,
    trajectory_figure,
)
from pinn_dyn.evaluation.drawing import GREY
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.systems import SoftArm


@pytest.fixture
def truth():
    t = torch.linspace(0, 2, 41, dtype=torch.float64)
    phase = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)[:, None]
    q = torch.stack([torch.sin(t + phase), torch.cos(2 * t + phase)], dim=-1)
    return Trajectory(q, torch.zeros_like(q), Signal(t, q[..., :1], "hold"))


@pytest.fixture
def predictions(truth):
    def prediction(q_hat):
        return Prediction(truth.t[::2], q_hat[:, ::2], truth.q[:, ::2])

    away = truth.q + torch.exp(8 * truth.t)[:, None] - 1
    broken = truth.q.clone()
    broken[1] = torch.nan
    return {
        "good": prediction(truth.q + 0.01 * truth.t[:, None]),
        "runaway": prediction(away),
        "fragile": prediction(broken + 0.02),
    }


def check_picture(figure, path):
    assert isinstance(figure, Figure)
    save(figure, path)
    pixels = matplotlib.image.imread(path)
    assert pixels.shape[1] == pytest.approx(150 * figure.get_figwidth(), abs=1)
    assert np.ptp(pixels[..., :3]) > 0.5


def test_trajectories_keep_the_range_of_the_truth(truth, predictions, tmp_path):
    figure = trajectory_figure(
        truth, predictions, trajectory=1, title="fake", labels=["x (m)", "y (rad)"]
    )
    check_picture(figure, tmp_path / "new" / "trajectories.png")
    drawn = {ax.get_ylabel(): ax for ax in figure.axes if ax.axison}
    first, inputs = drawn["x (m)"], drawn["u1"]
    assert first.get_ylim()[1] < 2 * float(truth.q.max())
    notes = first.get_title(loc="right")
    # exp(8 t) - 1 leaves a margin of some 0.4 within the first 0.1 s.
    assert "runaway leaves the panel at 0.1 s" in notes
    assert "fragile broke down at 0 s" in notes
    assert "good" not in notes
    assert list(drawn) == ["x (m)", "u1", "y (rad)", "‖q̂ − q‖₂ [m, rad]"]
    assert drawn["‖q̂ − q‖₂ [m, rad]"].get_yscale() == "log"
    assert inputs.get_xlabel() == "time [s]"
    assert inputs.lines[0].get_drawstyle() == "steps-post"
    assert figure.get_suptitle() == "fake"


def test_labels_must_fit_the_coordinates(truth, predictions):
    with pytest.raises(ValueError, match="labels has 1 entries, expected 2"):
        trajectory_figure(truth, predictions, trajectory=0, title="fake", labels=["x"])


def test_error_over_time_counts_the_diverged(predictions, tmp_path):
    figure = error_figure(predictions, title="fake", label="error (m)")
    check_picture(figure, tmp_path / "error.png")
    ax = figure.axes[0]
    assert ax.get_yscale() == "log"
    assert ax.get_ylabel() == "error (m)"
    labels = [line.get_label() for line in ax.lines]
    assert labels == ["good", "runaway (3 of 3 diverged)", "fragile (1 of 3 diverged)"]
    good, _, fragile = ax.lines
    prediction = predictions["good"]
    np.testing.assert_allclose(good.get_ydata(), 0.01 * 2**0.5 * prediction.t[1:])
    np.testing.assert_allclose(fragile.get_ydata(), 0.02 * 2**0.5)


def test_floors_are_thin_grey_lines_without_a_band(predictions, tmp_path):
    models = {"good": predictions["good"]}
    floors = {name: predictions["good"] for name in ("stands still", "ARX")}
    figure = error_figure(models, floors=floors, title="fake")
    check_picture(figure, tmp_path / "error.png")
    (ax,) = figure.axes
    model, *below = ax.lines
    assert [line.get_label() for line in below] == ["stands still", "ARX"]
    assert {line.get_color() for line in below} == {GREY}
    assert all(line.get_linewidth() < model.get_linewidth() for line in below)
    assert len({line.get_linestyle() for line in below}) == 2
    assert len(ax.collections) == 1  # the band of the model


def test_one_motion_has_its_floor_as_a_thin_grey_line(truth, predictions):
    models = {"good": predictions["good"]}
    floors = {"ARX": predictions["fragile"]}
    figure = trajectory_figure(truth, models, trajectory=0, title="fake", floors=floors)
    drawn = [ax.lines for ax in figure.axes if len(ax.lines) > 1]
    assert len(drawn) == truth.q.shape[-1] + 1  # coordinates and the error
    for *_, model, floor in drawn:
        assert [model.get_label(), floor.get_label()] == ["good", "ARX"]
        assert floor.get_color() == GREY
        assert floor.get_linewidth() < model.get_linewidth()
    np.testing.assert_array_equal(drawn[0][-1].get_ydata(), floors["ARX"].q_hat[0, :, 0])


def test_colours_follow_the_order_of_the_models(truth, predictions):
    lines = trajectory_figure(truth, predictions, trajectory=0, title="fake").axes[0].lines
    errors = error_figure(predictions, title="fake").axes[0].lines
    colours = [line.get_color() for line in errors]
    assert [line.get_color() for line in lines[1:]] == colours
    assert len(set(colours)) == 3


def test_no_two_of_many_models_are_drawn_alike(predictions, tmp_path):
    many = {f"run {k}": predictions["good"] for k in range(9)}
    figure = error_figure(many, title="fake")
    check_picture(figure, tmp_path / "error.png")
    looks = [(line.get_color(), line.get_linestyle()) for line in figure.axes[0].lines]
    assert len(set(looks)) == 9
    assert {line for _, line in looks[:6]} == {"-"}


@pytest.mark.parametrize(("inverse_mass", "shown"), [(False, "0.00173"), (True, "593")])
def test_terms_are_annotated(inverse_mass, shown, tmp_path):
    q = torch.tensor([[0.8, 0.2, 0.3], [1.2, -0.2, 0.15]])
    comparison = compare_terms(SoftArm(damping=0.12), SoftArm(), q)
    assert not comparison.of_inverse_mass
    comparison = replace(comparison, of_inverse_mass=inverse_mass)
    figure = terms_figure(comparison, configuration=1, title="fake")
    check_picture(figure, tmp_path / "terms.png")
    assert len(figure.axes) == 12
    assert shown in [text.get_text() for text in figure.axes[0].texts]
    assert len(figure.axes[2].texts) == 3  # G is one column
    assert figure.axes[5].get_xlabel() == "error 20 %"


def test_the_spread_of_an_ensemble_is_drawn_beside_its_error(truth, tmp_path):
    members = torch.stack([truth.q + c * truth.t[:, None] for c in (0.0, 0.1, 0.5)])
    members[:, 2] = torch.nan
    prediction = Prediction(truth.t, members.mean(0), truth.q, members)
    figure = spread_figure(prediction, title="fake")
    check_picture(figure, tmp_path / "spread.png")
    (ax,) = figure.axes
    error, spread = (line.get_ydata() for line in ax.lines)
    t = truth.t[1:].numpy()
    # Two coordinates, all off by c t; the third trajectory broke down.
    np.testing.assert_allclose(error, np.sqrt(2) * 0.2 * t)
    np.testing.assert_allclose(spread, np.sqrt(2 * np.var([0.0, 0.1, 0.5], ddof=1)) * t)
