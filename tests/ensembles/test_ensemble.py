"""An ensemble is its members: one by one, in the mean, on every kind of model."""

from functools import partial

import pytest
import torch

from pinn_dyn.ensembles import Ensemble
from pinn_dyn.mechanics import Signal, double_copy
from pinn_dyn.models import LearnedVelocity, NetworkResidual
from pinn_dyn.models.output_limits import output_limits, set_output_limits
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


@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_of_a_member_is_that_of_its_own_loss(kind):
    alone = members(kind)
    ensemble = Ensemble(alone)
    x0, t, u = motion(kind)
    weights = torch.randn(3, 4, 6, 4, generator=torch.Generator().manual_seed(5)).double()
    (weights * ensemble.member_increments(x0, t, Signal(t, u))).sum().backward()
    stacked = dict(ensemble.stack.template.model.named_parameters())
    for index, item in enumerate(alone):
        (weights[index] * item.increments(x0, t, Signal(t, u))).sum().backward()
        for name, parameter in item.named_parameters():
            found = stacked[name].grad
            if parameter.grad is None:  # a bias of the potential, say
                assert found is None or not found[index].any(), name
            else:
                torch.testing.assert_close(found[index], parameter.grad, rtol=1e-9, atol=1e-12)


def test_members_have_their_penalties():
    head = partial(NetworkResidual, hidden=[5])
    alone = [perturb(make_structured("lnn", 2, 2, residual=head), seed=k) for k in range(3)]
    ensemble = Ensemble(alone)
    at = torch.randn(4, 3, 7, 2, generator=torch.Generator().manual_seed(1)).double()
    expected = torch.stack([item.penalty(*at[:, k]) for k, item in enumerate(alone)])
    assert ensemble.penalized
    torch.testing.assert_close(ensemble.stack.penalty(*at), expected)


@pytest.mark.parametrize("kind", ["lnn", "next_state"])
def test_weights_are_saved_loaded_and_copied_with_one_copy_of_the_scales(kind):
    ensemble, other = Ensemble(members(kind)), Ensemble(members(kind, count=3)[::-1])
    saved = ensemble.state_dict()
    count = sum(p.numel() for p in ensemble.parameters())
    assert count == 3 * sum(p.numel() for p in ensemble.member(0).parameters())
    assert {value.shape[0] for name, value in saved.items() if name.endswith("weight")} == {3}
    other.load_state_dict(saved)
    x0, t, u = motion(kind)
    expected = ensemble.predict(x0, t, Signal(t, u))
    assert torch.equal(other.predict(x0, t, Signal(t, u)), expected)
    assert torch.equal(double_copy(ensemble).predict(x0, t, Signal(t, u)), expected)


def test_members_share_the_widest_of_their_limits():
    alone, q = members("lnn", 2), motion("lnn")[0][:, :2]
    for item in alone:
        set_output_limits(item, output_limits(item, q))
    first, second = (item.mass.output_limits for item in alone)
    assert not torch.equal(first, second)
    found = Ensemble(alone).member(1).mass.output_limits
    assert torch.equal(found[0], torch.minimum(first[0], second[0]))
    assert torch.equal(found[1:], torch.maximum(first[1:], second[1:]))
