"""The fastest motion in the data, and steps that are too long for it."""

import math

import pytest
import torch

from pinn_dyn.data.bandwidth import periods, too_long_for
from pinn_dyn.mechanics import Signal, Trajectory

LABELS = ["bend", "length"]


def trajectory(seconds, periods, noise=0.0):
    """Each velocity is a mean, an oscillation and noise."""
    t = torch.arange(int(seconds / 0.01) + 1, dtype=torch.float64) * 0.01
    generator = torch.Generator().manual_seed(0)
    v = torch.stack([2 + torch.sin(2 * math.pi * t / period) for period in periods], -1)
    v = v + noise * torch.randn(v.shape, generator=generator, dtype=torch.float64)
    return Trajectory(v.cumsum(0) * 0.01, v, Signal(t, v))


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_the_period_of_each_coordinate_is_measured_despite_noise(noise):
    motions = [trajectory(10, (2.0, 0.5), noise), trajectory(4, (2.0, 0.5), noise)]
    assert periods(motions).tolist() == pytest.approx([2.0, 0.5], rel=0.05)
    motions[0].v[:, 1] = 0.0
    assert periods(motions[:1])[1] == math.inf


def test_a_step_that_is_too_long_is_named_with_the_coordinate():
    motions = [trajectory(10, (2.0, 0.5))]
    assert too_long_for(motions, 0.05, LABELS) is None
    text = too_long_for(motions, 0.1, LABELS)
    assert "a step of 0.1 s" in text
    assert "that of length" in text
    assert "0.06" in text  # s, an eighth of the period
