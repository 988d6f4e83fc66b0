"""Figures show the numbers that they are made of, in a range that a runaway does not set."""

import dataclasses
import math

import matplotlib.image
import numpy as np
import pandas as pd
import pytest
import torch

from pinn_dyn.control.closed_loop import ClosedLoopRecord
from pinn_dyn.control.contracts import Motion
from pinn_dyn.evaluation import (
    Prediction,
    closed_loop_figure,
    compare_terms,
    error_figure,
    save,
    sweep_figure,
    terms_figure,
    trajectory_figure,
)
from pinn_dyn.evaluation.figures import modes_figure
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models.modes import modes_of
from pinn_dyn.plots import BASELINE
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

    broken = truth.q.clone()
    broken[1] = torch.nan
    return {
        "good": prediction(truth.q + 0.01 * truth.t[:, None]),
        "runaway": prediction(truth.q + torch.exp(8 * truth.t)[:, None] - 1),
        "fragile": prediction(broken + 0.02),
    }


def panels(figure):
    """Return the panels of a figure by the label of the vertical axis."""
    return {ax.get_ylabel(): ax for ax in figure.axes if ax.axison}


def lines(ax):
    """Return the lines of a panel by their names."""
    return {line.get_label(): line for line in ax.lines}


def test_a_trajectory_keeps_the_range_of_the_truth(truth, predictions, tmp_path):
    baselines = {"ARX": predictions["good"]}
    figure = trajectory_figure(
        truth,
        predictions,
        trajectory=1,
        title="t",
        labels=["x (m)", "y (rad)"],
        baselines=baselines,
    )
    save(figure, tmp_path / "new" / "trajectory.png")
    assert np.ptp(matplotlib.image.imread(tmp_path / "new" / "trajectory.png")[..., :3]) > 0.5
    axes = panels(figure)
    assert set(axes) == {"x (m)", "y (rad)", "‖q̂ − q‖₂ [m, rad]", "u1"}
    drawn = lines(axes["y (rad)"])
    assert axes["y (rad)"].get_ylim()[1] < 2 * float(truth.q.max())
    assert {"truth", "good", "runaway (diverged)", "fragile (diverged)", "ARX"} == set(drawn)
    np.testing.assert_array_equal(drawn["truth"].get_ydata(), truth.q[1, :, 1])
    np.testing.assert_array_equal(drawn["ARX"].get_ydata(), predictions["good"].q_hat[1, :, 1])
    assert drawn["ARX"].get_color() == BASELINE
    assert axes["u1"].lines[0].get_drawstyle() == "steps-post"


def test_errors_over_time_leave_out_and_count_the_diverged(predictions):
    models = {**predictions, **{f"run {k}": predictions["good"] for k in range(9)}}
    figure = error_figure(models, baselines={"ARX": predictions["good"]}, title="t", label="e (m)")
    (ax,) = figure.axes
    assert (ax.get_yscale(), ax.get_ylabel()) == ("log", "e (m)")
    drawn = lines(ax)
    names = list(drawn)
    assert names[:3] == ["good", "runaway (3 of 3 diverged)", "fragile (1 of 3 diverged)"]
    t = predictions["good"].t[1:].numpy()
    np.testing.assert_allclose(drawn["good"].get_ydata(), 0.01 * math.sqrt(2) * t)
    np.testing.assert_allclose(drawn[names[2]].get_ydata(), 0.02 * math.sqrt(2))
    looks = {(line.get_color(), line.get_linestyle()) for line in drawn.values()}
    assert len(looks) == len(drawn)  # no two models look alike
    assert len(ax.collections) == len(models) - 1  # bands: no finite error, no band; no baseline


@pytest.mark.parametrize(("inverse_mass", "entry"), [(False, "0.00173"), (True, "593")])
def test_terms_are_annotated_with_their_numbers(inverse_mass, entry):
    q = torch.tensor([[0.8, 0.2, 0.3], [1.2, -0.2, 0.15]])
    comparison = compare_terms(SoftArm(damping=0.12), SoftArm(), q)
    comparison = dataclasses.replace(comparison, of_inverse_mass=inverse_mass)
    figure = terms_figure(comparison, configuration=1, title="t")
    assert len(figure.axes) == 12
    assert entry in [text.get_text() for text in figure.axes[0].texts]
    assert len(figure.axes[2].texts) == 3  # G is one column
    assert figure.axes[5].get_xlabel() == "error 20 %"


def record(coordinates=3, decay=3.0, runs=4):
    """Steps that decay exponentially, with the input q_ref cos(t)."""
    t = torch.linspace(0, 2, 101, dtype=torch.float64)
    goal = torch.arange(1, coordinates + 1) + torch.arange(runs)[:, None, None] / 10
    q_ref = goal.double().expand(runs, len(t), coordinates)
    q = q_ref * (1 - torch.exp(-decay * t)[:, None])
    u = q_ref * torch.cos(t)[:, None]
    zero = torch.zeros_like(q)
    return ClosedLoopRecord(t, q, zero, u, u, Motion(q_ref, zero, zero), [None] * runs)


def test_a_closed_loop_shows_states_references_errors_and_inputs():
    slow, fast = record(), record(decay=5.0)
    figure = closed_loop_figure({"slow": slow, "fast": fast}, 1, title="t", labels=["x", "y", "z"])
    axes = panels(figure)
    assert set(axes) == {"x", "y", "z", "‖q_ref − q‖₂", "u1", "u2", "u3"}
    drawn = lines(axes["z"])
    np.testing.assert_array_equal(drawn["slow"].get_ydata(), slow.q[1, :, 2])
    np.testing.assert_array_equal(drawn["reference"].get_ydata(), slow.reference.q[1, :, 2])
    _, error = axes["‖q_ref − q‖₂"].lines
    size = np.linalg.norm([1.1, 2.1, 3.1])
    np.testing.assert_allclose(error.get_ydata(), size * np.exp(-5 * slow.t.numpy()))
    assert {line.get_drawstyle() for line in axes["u1"].lines} == {"steps-post"}


def test_a_sweep_has_a_line_through_the_means_over_seeds():
    runs = pd.DataFrame(
        [
            {"x": x, "model": model, "seed": seed, "error": scale / x * (1 + 2 * seed)}
            for model, scale in (("lnn", 1.0), ("mlp", 10.0))
            for x in (1, 10, 100)
            for seed in (0, 1)
        ]
    )
    runs.loc[0, "error"] = math.inf
    (ax,) = sweep_figure(runs, x="x", lines=["model"], y="error").axes
    drawn = lines(ax)
    np.testing.assert_allclose(drawn["lnn (1 of 6 diverged)"].get_ydata(), [3.0, 0.2, 0.02])
    np.testing.assert_allclose(drawn["mlp"].get_ydata(), [20.0, 2.0, 0.2])
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")


def test_modes_have_their_frequencies_dampings_and_shapes():
    """Two decoupled damped oscillators of 1 Hz and 3 Hz, sampled every 10 ms."""
    step, frequency = 0.01, torch.tensor([1.0, 3.0]).double()
    damping, spread = torch.tensor([0.1, 0.5]).double(), torch.tensor([0.1, 2.0]).double()
    omega = 2 * math.pi * frequency
    zero, one = torch.zeros(2, 2).double(), torch.eye(2).double()
    rate = torch.cat(
        [
            torch.cat([zero, one], 1),
            torch.cat([-(omega**2).diag(), -(2 * damping * omega).diag()], 1),
        ]
    )
    A = torch.linalg.matrix_exp(step * rate)
    B = torch.cat([zero, torch.diag(torch.tensor([0.01, 20.0]).double())])
    modes = modes_of(A, B, torch.cat([one, zero], 1), step=step, spread=spread)
    order = [1, 0]  # variance of q under white noise: B^2 / (4 damping omega^3)
    assert torch.allclose(modes.frequency, frequency[order])
    assert torch.allclose(modes.damping, damping[order])
    share = B[2:].diagonal() / spread / (damping * omega**3).sqrt()
    assert math.isclose(modes.share[1], share[0] / share[1], rel_tol=0.02)
    assert torch.allclose(modes.relative_shapes, one[order], atol=1e-9)
    frame = modes.to_frame(["a [m]", "b [rad]"])
    assert math.isclose(frame["amplitude of b [rad]"][0], 2.0)
    left, right = modes_figure(modes, title="t", labels=["a [m]", "b [rad]"]).axes
    np.testing.assert_allclose(left.collections[0].get_offsets()[0], [3.0, 0.5])
    names = [text.get_text() for text in right.get_yticklabels()]
    assert names == ["1: 3 Hz, ζ 0.50", "2: 1 Hz, ζ 0.10"]
