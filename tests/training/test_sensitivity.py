"""Derivatives of known mechanics by its parameters against finite differences."""

from functools import partial

import pytest
import torch
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from pinn_dyn.mechanics import RK4
from pinn_dyn.models import LoadDependent, Stribeck
from pinn_dyn.training.sensitivity import Sensitivity
from tests.support.known import known_model, windows_of


@pytest.fixture(params=[Stribeck, LoadDependent])
def model(request):
    model = known_model(gain_spread=0.3, friction=request.param)
    generator = torch.Generator().manual_seed(3)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.3, generator=generator)
    return model


def differences(model, function, step=1e-5):
    """d function / dz by central differences, ``(..., P)``."""
    z = parameters_to_vector(model.parameters()).detach()
    columns = []
    for direction in torch.eye(len(z)).to(z):
        ends = []
        for sign in (1, -1):
            vector_to_parameters(z + sign * step * direction, model.parameters())
            with torch.no_grad():
                ends.append(function().clone())
        columns.append((ends[0] - ends[1]) / (2 * step))
    vector_to_parameters(z, model.parameters())
    return torch.stack(columns, dim=-1)


def assert_close(actual, expected):
    assert (actual - expected).abs().max() <= 1e-6 * expected.abs().max()


def test_the_force_and_the_gains_by_the_parameters(model):
    q, v, a, u = torch.randn(4, 6, model.num_coordinates).double()
    regressor = model.structure.regressor(q, v, a)

    def force():
        driven = model.friction.transmitted(v, model.drive_gain() * u)
        return model.inverse_dynamics(q, v, a) - driven

    sensitivity = Sensitivity(model)
    assert_close(sensitivity.force(regressor, v, a, u), differences(model, force))
    assert_close(sensitivity.gain(), differences(model, lambda: model.drive_gain()))


def test_fixed_gains_do_not_depend_on_the_parameters():
    model = known_model(gain_spread=0.0)
    assert not Sensitivity(model).gain().any()


@pytest.mark.parametrize("substeps", [1, 2])
def test_roll_outs_by_the_parameters(model, substeps):
    model.integrator = RK4(substeps)
    windows = windows_of(model, count=3, steps=3)
    increments = partial(model.increments, windows.start("qv"), windows.t, windows.input)
    expected = differences(model, lambda: increments()[:, 1:])
    assert_close(Sensitivity(model).rollout(windows), expected)
