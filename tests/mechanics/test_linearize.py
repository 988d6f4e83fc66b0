"""Linearized models against finite differences, SciPy and simulations."""

from functools import partial

import numpy as np
import pytest
import torch
from scipy.signal import cont2discrete

from pinn_dyn.mechanics import Signal
from pinn_dyn.models import Servo
from pinn_dyn.systems import SoftArm, TendonArm
from pinn_dyn.testing import assert_near
from pinn_dyn.testing.finite_differences import partial_derivatives
from tests.models.builders import NONLINEAR, make_model, make_structured
from tests.support.cart_pole import CartPole

MODELS = {
    "cart-pole-qp": partial(CartPole, state="qp"),
    "soft-arm": SoftArm,
    "tendon-arm": partial(TendonArm, tendons=4),
    "lnn": partial(make_structured, "lnn"),
    "hnn": partial(make_structured, "hnn"),
    "nonlinear-input": partial(make_structured, "lnn", **NONLINEAR),
    "saturating-servo": partial(make_structured, "lnn", input=partial(Servo, limit="learned")),
    "black-box": partial(make_model, "acceleration"),
}


@pytest.fixture(params=MODELS)
def model(request):
    return MODELS[request.param]()


def states(model, batch=4):
    generator = torch.Generator().manual_seed(0)
    sizes = (model.num_coordinates, model.num_coordinates, model.num_inputs)
    rows = (torch.rand(batch, n, generator=generator, dtype=torch.float64) for n in sizes)
    return [0.4 * x - 0.2 for x in rows]


def test_the_pair_is_that_of_finite_differences_and_sampled_that_of_scipy(model):
    q, v, u = states(model)
    A, B = model.linearize(q, v, u)
    x = torch.cat([q, v], -1)
    with torch.no_grad():
        by_x = partial_derivatives(
            lambda y: model.velocity_derivative(y, u.expand(*y.shape[:-1], -1)), x, 1e-5
        )
        by_u = partial_derivatives(
            lambda y: model.velocity_derivative(x.expand(*y.shape[:-1], -1), y), u, 1e-5
        )
    assert_near(A, by_x, 1e-6)
    assert_near(B, by_u, 1e-6)
    single = model.linearize(q[1], v[1], u[1])
    assert_near(single[0], A[1], 1e-12)
    spread = model.linearize(q, v[1], u[1])[1]  # (N,) and (M,) serve the whole batch
    assert_near(spread[1], B[1], 1e-12)
    A, B = A.detach().numpy(), B.detach().numpy()
    A_d, B_d = model.linearize(q, v, u, sample_time=0.02)
    for k in range(len(q)):
        n, m = B[k].shape
        pair = cont2discrete((A[k], B[k], np.eye(n), np.zeros((n, m))), 0.02, "zoh")[:2]
        assert_near(A_d[k], torch.from_numpy(pair[0]), 1e-10)
        assert_near(B_d[k], torch.from_numpy(pair[1]), 1e-10)


@pytest.mark.parametrize("kind", ["lnn", "hnn"])
def test_the_sampled_pair_is_the_slope_of_a_simulation_from_rest(kind):
    """A simulation of 0.2 s under held inputs, moved in each initial state and input."""
    model = make_structured(kind).requires_grad_(False)
    q = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    u = model.input_for(q, 0 * q, 0 * q)
    t = torch.linspace(0, 0.2, 81, dtype=torch.float64)

    def end(z):
        q, v, u = z.split(3, dim=-1)
        p = v if model.state == "qv" else model.momentum(q, v)
        held = Signal(t, u.unsqueeze(-2).expand(*u.shape[:-1], len(t), -1), "hold")
        q, p = model.predict(torch.cat([q, p], -1), t, held)[..., -1, :].chunk(2, -1)
        return torch.cat([q, p if model.state == "qv" else model.velocity(q, p)], -1)

    start = torch.cat([q, 0 * q, u])
    expected = partial_derivatives(end, start[None], 1e-3)[0]
    pair = model.linearize(q, 0 * q, u, sample_time=0.2)
    assert_near(torch.cat(pair, -1), expected, 1e-6)
