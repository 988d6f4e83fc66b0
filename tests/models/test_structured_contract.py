"""The contract of a mechanical system, for the learned ones with every kind of head."""

import pytest
import torch

from pinn_dyn.testing import MechanicalSystemContract, assert_near
from tests.models.builders import (
    NONLINEAR,
    TRANSPOSED,
    VARIANTS,
    make_structured,
    random_batch,
)
from tests.support.contracts import one_case, slow_except

MODELS = [(kind, variant) for kind in ("lnn", "hnn") for variant in VARIANTS]
FAST = [
    ("lnn", "silu-fixed-input-2x4"),
    ("lnn", "friction-angle-and-length-3x3"),
    ("hnn", "networks-softplus-3x3"),
    ("hnn", "friction-all-angles-2x1"),
]


@pytest.mark.parametrize("model", slow_except(MODELS, FAST), ids="-".join)
@one_case
class TestStructuredNetwork(MechanicalSystemContract):
    @pytest.fixture
    def system(self, model):
        kind, variant = model
        return make_structured(kind, **VARIANTS[variant])


@one_case
class TestTransposedMass(MechanicalSystemContract):
    @pytest.fixture
    def system(self):
        return make_structured("lnn", **TRANSPOSED)


@pytest.mark.parametrize("kind", ["lnn", "hnn"])
def test_a_nonlinear_input_moves_the_robot_in_every_form(kind):
    """Both forms of the dynamics, the inverse dynamics and the power have the head's force."""
    model = make_structured(kind, **NONLINEAR)
    q, v, _, u = random_batch(2, 3)
    force = model.input.force(q, u)
    assert float((force - (model.input_matrix(q) @ u[..., None])[..., 0]).abs().max()) > 0.05
    assert not model.input_affine
    a = model.forward_dynamics(q, v, u)
    assert_near(model.inverse_dynamics(q, v, a), force, 1e-9)
    power = (v * (force - model.dissipative_force(q, v))).sum(-1)
    assert_near(model.power(q, v, u), power, 1e-12)
    p = model.momentum(q, v)
    rates = model.momentum_derivative(torch.cat([q, p], -1), u)
    mass_rate = torch.func.jvp(model.mass_matrix, (q,), (v,))[1]
    expected = (model.mass_matrix(q) @ a[..., None] + mass_rate @ v[..., None])[..., 0]
    assert_near(rates, torch.cat([v, expected], -1), 1e-9)
