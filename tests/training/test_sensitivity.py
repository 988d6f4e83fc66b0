"""Derivatives of models of physical constants by these against finite differences."""

from functools import partial

import pytest
import torch
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from pinn_dyn.data.windows import draw_windows
from pinn_dyn.mechanics import RK4
from pinn_dyn.mechanics.integrators import Sticking
from pinn_dyn.models import Servo, Stribeck
from pinn_dyn.models.learned_constants import Slopes
from pinn_dyn.training.sensitivity import WindowRollouts
from tests.support.known import elastic_model, known_arm, known_model, motion, windows_of

MODELS = {
    "Stribeck": lambda: known_model(gain_spread=0.3, friction=Stribeck, springs=["bend", "turn"]),
    "servos": lambda: known_model(
        friction=Stribeck, input=partial(Servo, stiffness=3.0, limit="learned")
    ),
    "elastic joints": lambda: elastic_model(
        friction=Stribeck, gain_spread=0.3, springs=["fork", "turn"]
    ),
    "soft arm": known_arm,
    "two segments": lambda: known_arm(2),
}


@pytest.fixture(params=MODELS)
def model(request):
    model = MODELS[request.param]()
    generator = torch.Generator().manual_seed(9)  # no joint stops within the windows below
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.3, generator=generator)
    return model


def differences(model, function, directions=None, step=1e-5):
    """d function / dz by central differences, ``(..., P)``, or along directions ``(K, P)``."""
    z = parameters_to_vector(model.parameters()).detach()
    columns = []
    for direction in torch.eye(len(z)).to(z) if directions is None else directions:
        ends = []
        for sign in (1, -1):
            vector_to_parameters(z + sign * step * direction, model.parameters())
            with torch.no_grad():
                ends.append(function().clone())
        columns.append((ends[0] - ends[1]) / (2 * step))
    vector_to_parameters(z, model.parameters())
    return torch.stack(columns, dim=-1)


def some_directions(model):
    """Three directions of all parameters together, ``(3, P)``."""
    count = sum(p.numel() for p in model.parameters())
    return torch.randn(3, count, generator=torch.Generator().manual_seed(4)).double()


def sample(model):
    q, v, a = torch.randn(3, 6, model.num_coordinates).double()
    return q, v, a, torch.randn(6, model.num_inputs).double()


def assert_close(actual, expected, tolerance=1e-6):
    assert (actual - expected).abs().max() <= tolerance * expected.abs().max()


def test_the_force_and_the_gains_by_the_parameters(model):
    q, v, a, u = sample(model)
    slopes = model.slopes()
    directions = some_directions(model)
    force = differences(model, lambda: model.missing_force(q, v, a, u), directions)
    # Measured at most 2e-9: closer than by one parameter at a time, as all errors add up here.
    assert_close(slopes.by_parameters(q, v, a, u) @ directions.T, force, 1e-7)
    assert_close(slopes.gain(), differences(model, lambda: model.drive_gain()))


def test_closed_formulas_are_the_slopes_of_every_model(model):
    at = sample(model)
    own, plain = model.slopes(), Slopes(model)
    assert_close(own.by_parameters(*at), plain.by_parameters(*at))
    assert_close(own.by_state(*at), plain.by_state(*at))
    assert_close(own.gain(), plain.gain())


def test_samples_follow_the_parameters(model):
    """Of fixed samples, whose regressor was computed before."""
    at = sample(model)
    samples = model.samples(*at)
    with torch.no_grad():
        for part in model.parameters():
            part += 0.1
    assert_close(samples.missing_force(), model.missing_force(*at))
    assert_close(samples.by_parameters(), Slopes(model).by_parameters(*at))


def test_fixed_gains_do_not_depend_on_the_parameters():
    model = known_model(gain_spread=0.0)
    assert not model.slopes().gain().any()


def sensitivity_errors(model, windows, substeps, step=1e-5):
    """Relative errors of the derivatives of rollouts with finer and finer steps."""
    directions, errors = some_directions(model), []
    sticks = isinstance(model.integrator, Sticking)
    for number in substeps:
        model.integrator = Sticking(RK4(number)) if sticks else RK4(number)
        rollouts = WindowRollouts(model, windows)
        increments = partial(model.increments, windows.start("qv"), windows.t, windows.input)
        expected = differences(model, lambda f=increments: f()[:, 1:], directions, step)
        error = rollouts.slopes() @ directions.T - expected
        errors.append(float(error.norm() / expected.norm()))
    return errors


def test_rollouts_by_the_parameters(model):
    """The implicit midpoint rule has the order 2."""
    coarse, fine = sensitivity_errors(model, windows_of(model, count=3, steps=2), (1, 3))
    assert coarse < 0.05
    assert fine < coarse / 5 or fine < 1e-6


def test_rollouts_with_stops_by_the_parameters():
    """Joints stop, turn and stick within the windows."""
    model = known_model(friction=Stribeck)
    windows = draw_windows([motion(model, seconds=1.0)], count=20, steps=6, stride=2, seed=0)
    x0 = windows.start("qv")
    increments = partial(model.increments, x0, windows.t, windows.input)
    with torch.no_grad():
        v = (x0[:, None] + increments()).chunk(2, dim=-1)[1]
    assert (v == 0).any()
    assert (v[:, 1:] * v[:, :-1] < 0).any()
    coarse, fine = sensitivity_errors(model, windows, (1, 3), step=1e-6)
    assert coarse < 0.02
    assert fine < coarse / 5
