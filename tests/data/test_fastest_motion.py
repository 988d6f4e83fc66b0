"""The fastest motion in the data, and steps that are too long for it."""

import math

import pytest
import torch

from pinn_dyn.data.fastest_motion import periods, too_long_for
from pinn_dyn.mechanics import Signal, Trajectory

LABELS = ["bend", "length"]


def trajectory(seconds, periods, noise=0.0):
    """Each velocity is a mean, an oscillation and noise."""
    t = torch.arange(int(seconds / 0.01) + 1, dtype=torch.float64) * 0.01
    generator = torch.Generator().manual_seed(0)
    v = torch.stack([2 + torch.sin(2 * math.pi * t / period) for period in periods], -1)
    v = v + noise * torch.randn(v.shape, generator=generator, dtype=torch.float64)
    return Trajectory(v.cumsum(0) * 0.01, v, Signal(t, v))


def test_the_period_of_each_coordinate_is_found_over_trajectories_of_any_length():
    motions = [trajectory(10, (2.0, 0.5)), trajectory(4, (2.0, 0.5))]
    torch.testing.assert_close(
        periods(motions), torch.tensor([2.0, 0.5], dtype=torch.float64), rtol=0.05, atol=0
    )


def test_noise_on_a_measured_velocity_is_no_motion():
    found = periods([trajectory(10, (2.0, 0.5), noise=0.3)])
    assert found.tolist() == pytest.approx([2.0, 0.5], rel=0.05)


def test_what_stands_still_has_no_period():
    still = trajectory(10, (2.0, 0.5))
    still.v[:, 1] = 0.0
    assert periods([still])[1] == math.inf


def test_a_step_that_is_too_long_is_named_with_the_coordinate():
    motions = [trajectory(10, (2.0, 0.5))]
    assert too_long_for(motions, 0.05, LABELS) is None
    text = too_long_for(motions, 0.1, LABELS)
    assert "a step of 0.1 s" in text
    assert "that of length" in text
    assert "0.06" in text  # s, an eighth of the period
