"""Baselines, the common grid of several models, default horizon and windows."""

import logging

import pytest
import torch

from pinn_dyn.evaluation import build_baselines, predict_trajectories
from pinn_dyn.evaluation.prediction import common_stride, default_windows
from pinn_dyn.mechanics import Signal, Trajectory, stack

T = 0.05 * torch.arange(81, dtype=torch.float64)


def swings(count, seed=0, samples=81):
    """Free oscillations a cos(3 t + phase) of two coordinates; the input has no effect."""
    generator = torch.Generator().manual_seed(seed)
    found = []
    for _ in range(count):
        a, phase = 1 + torch.rand(2, 2, generator=generator, dtype=torch.float64)
        angle = 3 * T[:samples, None] + 4 * phase
        u = torch.randn(samples, 1, generator=generator, dtype=torch.float64)
        q, v = a * torch.cos(angle), -3 * a * torch.sin(angle)
        found.append(Trajectory(q, v, Signal(T[:samples], u)))
    return found


@pytest.fixture(scope="module")
def baselines():
    return build_baselines(swings(4), swings(2, seed=1), step=0.1)


def test_baselines_predict_what_their_names_say(baselines):
    truth = stack(swings(3, seed=2))
    assert list(baselines) == ["hold position", "constant velocity", "ARX", "EDMDc degree 2"]
    still, moving, arx, _ = (
        predict_trajectories(model, truth, step=0.1).q_hat for model in baselines.values()
    )
    torch.testing.assert_close(still, truth.q[:, :1].expand_as(still))
    expected = truth.q[:, :1] + truth.v[:, :1] * T[::2, None]
    torch.testing.assert_close(moving, expected)
    torch.testing.assert_close(arx, truth.q[:, ::2], rtol=0, atol=1e-5)


def test_windowed_baselines_restart_from_the_measured_state(baselines):
    truth = stack(swings(1, seed=2))
    found = predict_trajectories(baselines["constant velocity"], truth, window=1.0, step=0.1)
    samples = torch.arange(81)
    start = ((samples - 1).clamp(min=0) // 20) * 20
    expected = truth.q[0, start] + truth.v[0, start] * (T - T[start])[:, None]
    torch.testing.assert_close(found.q_hat[0], expected[::2])


def test_a_rival_that_cannot_be_fitted_is_left_out_with_a_reason(caplog):
    with caplog.at_level(logging.WARNING):
        baselines = build_baselines(swings(2, samples=3), swings(1), step=0.2)
    assert list(baselines) == ["hold position", "constant velocity"]
    assert "no row 'ARX': no linear model can be fitted: all training traj" in caplog.text


@pytest.mark.parametrize(
    ("steps", "stride"), [([0.05], 1), ([0.1, 0.15], 6), ([0.05, 0.2], 4), ([0.1, 0.1], 2)]
)
def test_models_of_several_steps_meet_at_common_times(steps, stride):
    assert common_stride(steps, T) == stride


def test_steps_without_a_common_time_are_refused():
    with pytest.raises(ValueError, match=r"steps of \[1\.9, 2\.1\] s have no time in common"):
        common_stride([1.9, 2.1], T)
    with pytest.raises(ValueError, match=r"step is 0\.07 s and the sample time"):
        common_stride([0.07], T)


@pytest.mark.parametrize(
    ("horizon", "grid", "windows"),
    [
        (5.0, 0.01, [0.1, 0.5, 1.0]),
        (3.0, 0.04, [1.0]),  # 25 Hz: neither 0.1 s nor 0.5 s is a multiple of the sample time
        (0.4, 0.4, []),
    ],
)
def test_the_default_windows_fit_the_data(horizon, grid, windows):
    assert default_windows(horizon, grid) == pytest.approx(windows)
