import dataclasses

import matplotlib.image
import numpy as np
import pytest
import torch

from pinn_dyn.control.contracts import Motion
from pinn_dyn.control.record import ClosedLoopRecord
from pinn_dyn.evaluation import save
from pinn_dyn.evaluation.control_figures import (
    closed_loop_figure,
    controller_comparison_figure,
    steady_state_figure,
    tip_path_figure,
)


def make_record(coordinates, inputs=None, decay=3.0, runs=4):
    t = torch.linspace(0, 2, 101, dtype=torch.float64)
    goal = torch.arange(1, coordinates + 1) + torch.arange(runs)[:, None, None] / 10
    q_ref = goal.double().expand(runs, len(t), coordinates)
    q = q_ref * (1 - torch.exp(-decay * t)[:, None])
    u = q_ref[..., : inputs or coordinates] * torch.cos(t)[:, None]
    zero = torch.zeros_like(q)
    return ClosedLoopRecord(t, q, zero, u, u, Motion(q_ref, zero, zero), [None] * runs)


def stop(record, run, sample, reason="0.80 s: too fast"):
    values = {name: getattr(record, name).clone() for name in ("q", "v", "u", "u_wanted")}
    for value in values.values():
        value[run, sample:] = torch.nan
    stopped = list(record.stopped)
    stopped[run] = reason
    return dataclasses.replace(record, stopped=stopped, **values)


def check_picture(figure, path):
    save(figure, path)
    pixels = matplotlib.image.imread(path)
    assert np.ptp(pixels[..., :3]) > 0.5


def panels(figure):
    """The panels of a figure by the names of their vertical axes."""
    return {ax.get_ylabel(): ax for ax in figure.axes if ax.axison}


def test_states_and_error_stand_beside_the_inputs(tmp_path):
    record = make_record(3, inputs=2)
    figure = closed_loop_figure(
        record, 1, title="fake", labels=["x (m)", "y (m)", "z (m)"], input_labels=["a", "b"]
    )
    check_picture(figure, tmp_path / "run.png")
    found = panels(figure)
    assert set(found) == {"x (m)", "y (m)", "z (m)", "‖q_ref − q‖₂ [m]", "a", "b"}
    for k, name in enumerate(("x (m)", "y (m)", "z (m)")):
        reached, wanted = found[name].lines
        np.testing.assert_array_equal(reached.get_ydata(), record.q[1, :, k])
        np.testing.assert_array_equal(wanted.get_ydata(), record.reference.q[1, :, k])
        assert wanted.get_linestyle() == ":"
    # |q_ref - q| = |q_ref| exp(-3 t)
    (error,) = found["‖q_ref − q‖₂ [m]"].lines
    size = np.linalg.norm([1.1, 2.1, 3.1])
    np.testing.assert_allclose(error.get_ydata(), size * np.exp(-3 * record.t.numpy()))
    for name in ("a", "b"):
        assert [line.get_drawstyle() for line in found[name].lines] == ["steps-post"]
    assert figure.get_suptitle() == "fake"


def test_without_labels_they_are_counted(tmp_path):
    figure = closed_loop_figure(make_record(7, inputs=5), 0, title="fake")
    check_picture(figure, tmp_path / "run.png")
    assert len(figure.axes) == 2 * 8
    names = [f"q{k}" for k in range(1, 8)] + [f"u{k}" for k in range(1, 6)]
    assert set(panels(figure)) == {*names, "‖q_ref − q‖₂"}


def test_a_stop_is_marked_and_explained():
    figure = closed_loop_figure(stop(make_record(2), 2, 41), 2, title="fake")
    assert figure.get_suptitle() == "fake\nstopped: 0.80 s: too fast"
    for ax in panels(figure).values():
        assert any(line.get_xdata() == pytest.approx([0.8, 0.8]) for line in ax.lines)
        assert not ax.get_title(loc="right")  # the stop is said once


def test_a_run_that_ran_away_does_not_set_the_scale():
    record = make_record(2)
    record.q[2, 39:], record.u[2, 39:] = 1e3, -1e5
    found = panels(closed_loop_figure(stop(record, 2, 41), 2, title="fake"))
    for name in ("q1", "q2", "u1", "u2"):
        assert np.abs(found[name].get_ylim()).max() < 2 * 7.2
    assert found["u1"].get_title(loc="right") == "reached leaves the panel at 0.78 s"


def test_a_run_whose_law_failed_at_once_is_drawn(tmp_path):
    record = stop(make_record(2), 0, 1)
    record.u[0, 0] = torch.nan
    check_picture(closed_loop_figure(record, 0, title="fake"), tmp_path / "run.png")


def test_labels_must_fit():
    with pytest.raises(ValueError, match="input_labels has 1 entries, expected 2"):
        closed_loop_figure(make_record(2), 0, title="fake", input_labels=["a"])


def test_controllers_are_compared_by_their_mean_errors(tmp_path):
    fast, slow = make_record(1, decay=5.0), make_record(1, decay=1.0)
    lost = make_record(1)
    for run in range(4):
        lost = stop(lost, run, 9)
    figure = controller_comparison_figure(
        {"fast": fast, "slow": stop(slow, 3, 50), "lost": lost}, title="fake", label="error (rad)"
    )
    check_picture(figure, tmp_path / "controllers.png")
    ax = figure.axes[0]
    assert ax.get_yscale() == "log"
    labels = [line.get_label() for line in ax.lines]
    assert labels == ["fast", "slow (1 of 4 stopped)", "lost (4 of 4 stopped)"]
    # Steps of 1.0, 1.1, 1.2 and 1.3; the last is left out of the slow ones.
    t = fast.t[1:].numpy()
    np.testing.assert_allclose(ax.lines[0].get_ydata(), 1.15 * np.exp(-5 * t))
    np.testing.assert_allclose(ax.lines[1].get_ydata(), 1.10 * np.exp(-t))
    band = ax.collections[1].get_paths()[0].vertices
    start = band[band[:, 0] == t[0], 1] / np.exp(-t[0])
    assert (start.min(), start.max()) == pytest.approx((1.02, 1.18))  # 10 and 90 % of 1 to 1.2


def test_an_error_that_starts_at_zero_does_not_stretch_the_axis(tmp_path):
    record = make_record(1)
    record.q[:, 0] = record.reference.q[:, 0]
    record.q[:, 1] = record.reference.q[:, 1] + 1e-15
    figure = controller_comparison_figure({"tracking": record}, title="fake")
    check_picture(figure, tmp_path / "controllers.png")
    assert figure.axes[0].get_ylim()[0] > 1e-6


def test_tip_path_shows_the_distance_in_millimetres(tmp_path):
    t = torch.linspace(0, 3, 61, dtype=torch.float64)
    helix = torch.stack([t.cos(), t.sin(), 0.1 * t], -1)
    near = helix + 0.001 * torch.tensor([2.0, 3.0, 6.0])
    short = helix + 0.02 * t[:, None] * torch.tensor([0.0, 0.0, 1.0])
    short[30:] = torch.nan
    figure = tip_path_figure(t, {"near": near, "short": short}, helix, title="fake")
    check_picture(figure, tmp_path / "tip.png")
    space, distance = figure.axes
    assert space.name == "3d"
    np.testing.assert_allclose(distance.lines[0].get_ydata(), 7.0)
    np.testing.assert_allclose(distance.lines[1].get_ydata()[:30], 20 * t[:30])
    assert [text.get_text() for text in distance.texts] == ["short stopped"]
    with pytest.raises(ValueError, match=r"path 'near' has shape \(60, 3\), expected \(61, 3\)"):
        tip_path_figure(t, {"near": near[1:]}, helix, title="fake")


def test_bounds_that_fail_are_counted_and_drawn_as_crosses(tmp_path):
    inf = float("inf")
    bound = torch.tensor([1e-2, 1e-2, 1e-3, 0.0, inf, 1e-2])
    measured = torch.tensor([1e-3, 1e-2, 2e-3, 1e-6, 1e-3, inf])
    figure = steady_state_figure(bound, measured, title="fake")
    check_picture(figure, tmp_path / "bound.png")
    ax = figure.axes[0]
    below, above = (np.asarray(points.get_offsets()) for points in ax.collections)
    np.testing.assert_allclose(below, [[1e-2, 1e-3], [1e-2, 1e-2]])
    np.testing.assert_allclose(above, [[1e-3, 2e-3], [1e-12, 1e-6]])
    assert ax.get_xlim() == ax.get_ylim()
    assert figure.get_suptitle().splitlines() == [
        "fake",
        "2 of 5 bounds hold",
        "not drawn: 1 without a bound, 1 without a finite error",
    ]


def test_bounds_that_all_hold_need_no_warning(tmp_path):
    figure = steady_state_figure(torch.ones(3), torch.full((3,), 0.1), title="fake")
    check_picture(figure, tmp_path / "bound.png")
    assert figure.get_suptitle() == "fake\n3 of 3 bounds hold"
    assert len(figure.axes[0].collections) == 1
    with pytest.raises(ValueError, match=r"bound has shape \(3,\) and measured \(2,\)"):
        steady_state_figure(torch.ones(3), torch.ones(2), title="fake")


def test_a_spike_of_the_input_leaves_the_rest_readable():
    record = make_record(3)
    calm = panels(closed_loop_figure(record, 0, title="calm"))["u1"]
    u = record.u.clone()
    u[:, 0] = 1e4
    spiked = panels(closed_loop_figure(dataclasses.replace(record, u=u), 0, title="spike"))["u1"]
    assert calm.get_title(loc="right") == ""
    assert spiked.get_ylim()[1] < 3 * calm.get_ylim()[1]
    assert spiked.get_title(loc="right") == "reached leaves the panel at 0 s"
