"""Properties of all models: batch shapes, precision, saving, copying, compiling."""

import copy
import pickle

import pytest
import torch

from pinn_dyn.mechanics import Signal
from pinn_dyn.testing import assert_near
from tests.models.builders import STEP, make_model, perturb, random_batch

KINDS = [
    "lnn",
    "hnn",
    "next_state",
    "acceleration",
    "subnet",
    "oscillators",
    "oscillators_of_the_past",
]
DISCRETE = ("next_state", "subnet", "oscillators", "oscillators_of_the_past")
T = STEP * torch.arange(4, dtype=torch.float64)


def windows(batch=(6,), dtype=torch.float64):
    """Initial states and inputs at the four times T."""
    q, v, _, u = random_batch(2, 2, batch=6, dtype=dtype)
    x0 = torch.cat([q, v], -1)
    u = torch.stack([u, 0.5 * u, -u, 0.2 * u], -2)
    return x0.reshape(*batch, 4), u.reshape(*batch, 4, 2)


@pytest.fixture(params=KINDS)
def kind(request):
    return request.param


def test_any_batch_shape_gives_the_same_prediction(kind):
    model = make_model(kind)
    x0, u = windows()
    expected = model.predict(x0, T, Signal(T, u))
    assert expected.shape == (6, 4, 4)
    assert_near(model.predict(x0[2], T, Signal(T, u[2])), expected[2], 1e-12)
    x0, u = windows((2, 3))
    assert_near(model.predict(x0, T, Signal(T, u)), expected.reshape(2, 3, 4, 4), 1e-12)


def test_a_prediction_starts_at_the_initial_state_and_moves(kind):
    x0, u = windows()
    model = make_model(kind)
    path = model.predict(x0, T, Signal(T, u))
    assert torch.equal(path[:, 0], x0)
    assert float((path[:, 1:] - path[:, :-1]).abs().amax((0, 1)).min()) > 1e-3
    assert_near(model.increments(x0, T, Signal(T, u)), path - x0[:, None], 1e-12)


def test_a_saved_model_carries_its_scales(kind):
    """Normalization is part of the state: a model built from other data loads it back."""
    model = make_model(kind)
    with torch.no_grad():
        for buffer in model.buffers():
            if buffer.is_floating_point():
                buffer *= 1.25
    model_of_other_data = make_model(kind)
    x0, u = windows()
    # A step is one of these scales: the saved black box has learned another one.
    t = 1.25 * T if kind in DISCRETE else T
    model_of_other_data.load_state_dict(model.state_dict())
    assert torch.equal(
        model_of_other_data.predict(x0, t, Signal(t, u)), model.predict(x0, t, Signal(t, u))
    )
    if kind not in DISCRETE:
        assert not torch.allclose(
            make_model(kind).predict(x0, t, Signal(t, u)), model.predict(x0, t, Signal(t, u))
        )


def test_a_copy_predicts_alike_and_is_independent(kind):
    model = make_model(kind)
    x0, u = windows()
    before = model.predict(x0, T, Signal(T, u))
    for other in (copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
        assert torch.equal(other.predict(x0, T, Signal(T, u)), before)
        perturb(other, seed=2)
        assert torch.equal(model.predict(x0, T, Signal(T, u)), before)
        assert not torch.equal(other.predict(x0, T, Signal(T, u)), before)
