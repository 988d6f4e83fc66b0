"""The networks' explicit formulas against automatic differentiation of L(q, v) and H(q, p)."""

import pytest
import torch

from pinn_dyn.mechanics import Signal
from pinn_dyn.testing import assert_near
from tests.models.autodiff import autodiff_derivative, rk4_increment
from tests.models.builders import CHAIN, TRANSPOSED, VARIANTS, make_structured, random_batch
from tests.support.contracts import slow_except

STEP = 0.05


def batch_of(model):
    q, second, a, u = random_batch(model.num_coordinates, model.num_inputs)
    return torch.cat([q, second], -1), u, torch.cat([a, q], -1)


MODELS = {
    **{f"{kind} {name}": (kind, VARIANTS[name]) for kind in ("lnn", "hnn") for name in VARIANTS},
    "lnn transposed": ("lnn", TRANSPOSED),
    **{f"{kind} chain": (kind, settings) for kind, settings in CHAIN.items()},
    "hnn in velocities": ("hnn", {"state": "qv"}),
}
ALIKE = ("constant", "fixed", "bounded")  # heads without second derivatives, or like others
FAST = [name for name in MODELS if not name.split()[1].startswith(ALIKE)]


@pytest.mark.parametrize("name", slow_except(MODELS, FAST))
def test_state_derivative_is_that_of_the_scalar_function(name):
    """So are a step and its gradients, by second derivatives of the heads."""
    kind, variant = MODELS[name]
    model = make_structured(kind, **variant)
    x, u, target = batch_of(model)
    assert_near(model.state_derivative(x, u), autodiff_derivative(model, x, u), 1e-9)
    leaves = [*model.parameters(), x.requires_grad_(True), u.requires_grad_(True)]
    t = torch.tensor([0.0, STEP], dtype=torch.float64)
    own = model.increments(x, t, Signal(t, torch.stack([u, 0.5 * u], -2)))[..., -1, :]
    plain = rk4_increment(lambda x, u: autodiff_derivative(model, x, u), x, u, 0.5 * u, STEP)
    assert_near(own, plain, 1e-9)
    gradients = [
        torch.autograd.grad(
            (value / STEP - target).square().mean(),
            leaves,
            allow_unused=True,
            materialize_grads=True,
        )
        for value in (own, plain)
    ]
    overall = max(float(gradient.abs().max()) for gradient in gradients[1])
    assert overall > 1e-3
    for actual, expected in zip(*gradients, strict=True):
        # A gradient that is zero (the last bias of V) is zero beside all others.
        assert_near(actual, expected, 1e-8, max(float(expected.abs().max()), 1e-6 * overall))


def test_a_transposed_head_is_refused_by_the_hamiltonian_network():
    with pytest.raises(ValueError, match="transposed=false"):
        make_structured("hnn", **TRANSPOSED)
