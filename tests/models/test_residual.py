"""The residual force: zero at the start, in every form of the dynamics, penalized, and counted."""

from functools import partial

import pytest
import torch

from pinn_dyn.data.windows import draw_windows
from pinn_dyn.evaluation import RolloutValidator
from pinn_dyn.evaluation.torque import residual_share
from pinn_dyn.mechanics import Signal, Trajectory, stack
from pinn_dyn.models import NetworkResidual
from pinn_dyn.testing import assert_near
from pinn_dyn.training import IncrementLoss, Penalized
from tests.models.builders import make_structured, random_batch

RESIDUAL = partial(NetworkResidual, hidden=[6])


def structured(**heads):
    return make_structured("lnn", n=2, m=3, **heads)


def motion(model):
    t = torch.linspace(0, 1, 51, dtype=torch.float64)
    u = torch.stack([torch.sin(k * t) for k in (1, 3, 5)], dim=-1)
    start = torch.tensor([0.1, -0.2, 0.3, 0.1], dtype=torch.float64)
    with torch.no_grad():
        q, v = model.predict(start, t, Signal(t, u)).chunk(2, dim=-1)
    return Trajectory(q, v, Signal(t, u))


def test_every_form_of_the_dynamics_has_it():
    with_r = structured(residual=RESIDUAL)
    without = structured()
    without.load_state_dict(with_r.state_dict(), strict=False)
    assert (with_r.has_residual, without.has_residual) == (True, False)
    q, v, a, u = random_batch(2, 3)
    r = with_r.residual_force(q, v, u)
    assert float(r.abs().max()) > 0.05
    expected = without.forward_dynamics(q, v, u) + torch.linalg.solve(with_r.mass_matrix(q), r)
    assert_near(with_r.forward_dynamics(q, v, u), expected, 1e-9)
    assert_near(with_r.power(q, v, u), without.power(q, v, u) + (v * r).sum(-1), 1e-9)
    assert_near(with_r.inverse_dynamics(q, v, a), without.inverse_dynamics(q, v, a), 1e-12)
    p = with_r.momentum(q, v)
    rates = with_r.momentum_derivative(torch.cat([q, p], -1), u)
    plain = without.momentum_derivative(torch.cat([q, p], -1), u)
    assert_near(rates - plain, torch.cat([torch.zeros_like(r), r], -1), 1e-9)


@pytest.mark.parametrize("weight", [0.5, 2.0])
def test_the_loss_of_training_adds_its_penalty(weight):
    model = structured(residual=partial(RESIDUAL, weight=weight))
    windows = draw_windows([motion(model)], count=20, steps=1, stride=1, seed=0)
    loss = IncrementLoss(windows.statistics(), model).double()
    q, v = windows.q, windows.v
    u = (windows.u[:, 0] + windows.u[:, 1]) / 2  # linear between samples
    share = model.residual_force(q, v, u) / model.residual.scale
    expected = loss(model, windows) + weight * (share**2).mean()
    assert_near(Penalized(loss)(model, windows), expected, 1e-9)


def test_its_share_of_the_force_is_reported():
    model = structured(residual=RESIDUAL)
    truth = stack([motion(model)])
    q, v, u = (x[0] for x in (truth.q, truth.v, truth.u))
    r = model.residual_force(q, v, u)
    driven = torch.einsum("tij,tj->ti", model.input_matrix(q), u)
    sizes = [float((x**2).sum(-1).mean().sqrt().detach()) for x in (r, driven)]
    expected = sizes[0] / sum(sizes)
    assert residual_share(model, truth) == pytest.approx(expected)
    validate = RolloutValidator(horizon=0.5, training_step=0.02)
    assert 0 < validate(model, truth)["residual_share"] < 1
    assert "residual_share" not in validate(structured(residual=None), truth)
