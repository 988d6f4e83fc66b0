"""The MLP's explicit tangent and reverse passes against torch.func."""

import pytest
import torch
import torch.nn.functional as F

from pinn_dyn.models import MLP
from pinn_dyn.testing import assert_near, slope
from tests.models.builders import perturb

LIMITS = torch.tensor([[-0.5, -1.0, -3.0], [1.0, 0.4, 2.0]])
PLAIN = {"softplus": F.softplus, "tanh": torch.tanh, "silu": F.silu}


def make_mlp(activation, hidden=(5, 4), normalized=True, limits=None, angles=()):
    torch.manual_seed(1)
    mean = torch.tensor([0.5, -0.3, 0.2]) if normalized else None
    std = torch.tensor([0.7, 1.4, 2.0]) if normalized else None
    return perturb(MLP(3, 2, hidden, activation, mean, std, angles, limits=limits).double())


@pytest.fixture(params=list(PLAIN))
def activation(request):
    return request.param


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_value_is_that_of_a_plain_loop(activation, batch):
    network = make_mlp(activation)
    generator = torch.Generator().manual_seed(2)
    x = 2 * torch.randn(*batch, 3, generator=generator, dtype=torch.float64)
    mean, std = torch.tensor([0.5, -0.3, 0.2]).double(), torch.tensor([0.7, 1.4, 2.0]).double()
    h = (x - mean) / std
    for k, layer in enumerate(network.layers):
        h = h @ layer.weight.T + layer.bias
        h = PLAIN[activation](h) if k < 2 else h
    assert network(x).shape == (*x.shape[:-1], 2)
    assert_near(network(x), h, 1e-12)
    assert_near(network.linearize(x)[0], h, 1e-12)


def test_the_passes_can_be_differentiated_again(activation):
    network = make_mlp(activation)
    x = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    dx, dy = torch.randn_like(x), torch.randn(4, 2, dtype=torch.float64)
    _, tangent, tape = network.linearize_along(x, dx)
    leaves = [x, *network.parameters()]
    plain_tangent = torch.func.jvp(network, (x,), (dx,))[1]
    plain_reverse = torch.func.vjp(network, x)[1](dy)[0]
    for own, plain in (
        (tangent, plain_tangent),
        (network.pullback(tape, dy), plain_reverse),
    ):
        gradients = [
            torch.autograd.grad(
                y.square().sum(),
                leaves,
                retain_graph=True,
                allow_unused=True,
                materialize_grads=True,
            )
            for y in (own, plain)
        ]
        assert all(float(g.abs().max()) > 1e-6 for g in gradients[1][:-1])
        for actual, expected in zip(*gradients, strict=True):
            assert_near(actual, expected, 1e-11, 1e-12 + float(expected.abs().max()))


@pytest.mark.parametrize(
    ("limits", "angles"), [(None, ()), (LIMITS.unbind(), (1,))], ids=["free", "limited, an angle"]
)
def test_the_passes_are_those_of_automatic_differentiation(activation, limits, angles):
    """At x inside and outside the limits."""
    network = make_mlp(activation, limits=limits, angles=angles)
    x, dx = 2 * torch.randn(2, 50, 3, dtype=torch.float64)
    dy = torch.randn(50, 2, dtype=torch.float64)
    value, tape = network.linearize(x)
    assert_near(value, network(x), 1e-12)
    assert_near(network.pullback(tape, dy), torch.func.vjp(network, x)[1](dy)[0], 1e-12)
    expected = torch.func.jvp(network, (x,), (dx,))
    for found, exact in zip(network.linearize_along(x, dx), expected, strict=False):
        assert_near(found, exact, 1e-12)
    second = lambda x: network.linearize_along(x, dx)[1]  # noqa: E731
    expected = slope(lambda e: second(x + e * dx), 1e-4)
    assert_near(torch.func.jvp(second, (x,), (dx,))[1], expected, 1e-4)


def test_limits_change_nothing_within_them_and_bound_all_beyond(activation):
    limited, plain = make_mlp(activation, limits=LIMITS.unbind()), make_mlp(activation)
    low, high = LIMITS.double()
    inside = low + (high - low) * torch.rand(50, 3, dtype=torch.float64)
    assert torch.equal(limited(inside), plain(inside))
    assert_near(limited(1e6 * inside), limited(1e4 * inside), 1e-12)
    # Never more than a standard deviation beyond: there the plain network has the same values.
    std = torch.tensor([0.7, 1.4, 2.0]).double()
    outside = torch.where(torch.rand(50, 3) > 0.5, high + 1e4, low - 1e4)
    corner = torch.where(outside > 0, high + std, low - std)
    assert_near(limited(outside), plain(corner), 1e-6)
