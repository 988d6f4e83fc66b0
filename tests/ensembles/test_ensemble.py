"""An ensemble is its members: one by one, in the mean, on every kind of model."""

from functools import partial

import pytest
import torch

from pinn_dyn.ensembles import Ensemble
from pinn_dyn.mechanics import Signal
from pinn_dyn.models import LearnedVelocity
from tests.models.builders import make_model, make_structured, perturb

KINDS = ("lnn", "hnn", "acceleration", "next_state", "subnet", "oscillators")


def members(kind, count=3):
    return [perturb(make_model(kind), seed=k, spread=0.1) for k in range(count)]


def motion(kind, seed=0):
    generator = torch.Generator().manual_seed(seed)
    step = 0.02 if kind in ("next_state", "subnet", "oscillators") else 0.002
    t = step * torch.arange(6, dtype=torch.float64)
    x0 = 0.3 * torch.randn(4, 4, generator=generator, dtype=torch.float64)
    return x0, t, torch.randn(4, 6, 2, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("kind", KINDS)
def test_an_ensemble_predicts_the_mean_of_what_its_members_predict_alone(kind):
    alone = members(kind)
    ensemble = Ensemble(alone)
    x0, t, u = motion(kind)
    expected = torch.stack([item.predict(x0, t, Signal(t, u, "hold")) for item in alone])
    assert (expected[0] - expected[1]).abs().max() > 1e-4
    found = x0[:, None] + ensemble.member_increments(x0, t, Signal(t, u, "hold"))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    found = ensemble.predict(x0, t, Signal(t, u, "hold"))
    torch.testing.assert_close(found, expected.mean(0), rtol=0, atol=1e-12)
    assert ensemble.fixed_step == alone[0].fixed_step


def test_members_start_at_velocities_of_their_own():
    head = partial(LearnedVelocity, hidden=[5])
    alone = [
        perturb(make_structured("lnn", 2, 2, initial_velocity=head), seed=k, spread=0.3)
        for k in range(2)
    ]
    x0, t, u = motion("lnn")
    expected = torch.stack([item.increments(x0, t, Signal(t, u)) for item in alone])
    assert (expected[0, :, 1] - expected[1, :, 1]).abs().max() > 1e-4
    found = Ensemble(alone).member_increments(x0, t, Signal(t, u))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def test_members_of_different_robots_or_steps_are_refused():
    for pair, name in (
        ([make_model("lnn"), make_model("hnn")], "state"),
        ([make_structured("lnn", 2, 2), make_structured("lnn", 3, 2)], "num_coordinates"),
        ([make_model("lnn"), make_model("next_state")], "fixed_step"),
    ):
        with pytest.raises(ValueError, match=f"differ in {name}"):
            Ensemble(pair)
