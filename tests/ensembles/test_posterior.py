"""Draws from the constants of a fit against the linear propagation of their covariance."""

import pytest
import torch

from pinn_dyn.ensembles import posterior_draws
from pinn_dyn.training.sensitivity import rollout_slopes
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
    slope = rollout_slopes(model, windows)
    expected = (slope @ covariance * slope).sum(-1).sqrt()
    torch.testing.assert_close(found.std(0), expected, rtol=0.1, atol=0)
    assert ((found.mean(0) - middle).abs() < 0.2 * expected).all()


def test_the_draws_are_the_same_every_time():
    model = known_model()
    first, second = (posterior_draws(model, covariance_of(model), size=3) for _ in range(2))
    pairs = list(zip(first.parameters(), second.parameters(), strict=True))
    assert all(torch.equal(a, b) for a, b in pairs)
    assert any((a[0] - a[1]).abs().max() > 0 for a, _ in pairs)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c[:3, :3], "covariance has 3 rows, but the model has"),
        (lambda c: -c, "not positive definite"),
        (lambda c: torch.nan * c, "not positive definite"),
    ],
)
def test_what_is_no_covariance_is_refused(change, message):
    model = known_model()
    with pytest.raises(ValueError, match=message):
        posterior_draws(model, change(covariance_of(model)))
