"""Draws from the constants of a fit against the linear propagation of their covariance."""

import torch

from pinn_dyn.ensembles import posterior_draws
from pinn_dyn.training.sensitivity import WindowRollouts
from tests.support.known import known_model, windows_of


def covariance_of(model, size=0.01):
    count = sum(p.numel() for p in model.parameters())
    root = torch.randn(count, count, generator=torch.Generator().manual_seed(1)).double()
    return size**2 * (root @ root.T / count + 0.1 * torch.eye(count).double())


def test_the_spread_of_predictions_is_that_of_the_linear_problem():
    model = known_model(gain_spread=0.3)
    windows, covariance = windows_of(model, count=3, steps=2), covariance_of(model)
    members = posterior_draws(model, covariance, size=500)
    with torch.no_grad():
        found = members.member_increments(windows.start("qv"), windows.t, windows.input)[:, :, 1:]
        middle = model.increments(windows.start("qv"), windows.t, windows.input)[:, 1:]
    slope = WindowRollouts(model, windows).slopes()
    expected = (slope @ covariance * slope).sum(-1).sqrt()
    torch.testing.assert_close(found.std(0), expected, rtol=0.1, atol=0)
    assert ((found.mean(0) - middle).abs() < 0.2 * expected).all()
