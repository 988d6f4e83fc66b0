"""The networks' explicit formulas against automatic differentiation of L(q, v) and H(q, p).

The two share the values of the terms, and no formula of a derivative.
"""

import pytest
import torch
from torch.func import grad, hessian, jacrev, vmap

from pinn_dyn.mechanics import Signal
from pinn_dyn.models import CoulombFriction
from pinn_dyn.testing import assert_near
from tests.models.builders import CHAIN, TRANSPOSED, VARIANTS, make_structured, random_batch
from tests.support.contracts import slow_except

STEP = 0.05


def dissipation(model, q, v):
    """D v, and where the model has it the Coulomb law, written out anew."""
    force = model.damping_matrix(q) @ v
    head = model.friction
    if not isinstance(head, CoulombFriction):
        return force
    level = head.level.scale * torch.log(1 + torch.exp(head.level.z))
    width = head.width.scale * (torch.log(1 + torch.exp(head.width.z)) + 0.01)
    return force + level * (1 - 2 / (torch.exp(2 * v / width) + 1))


def lagrangian_derivative(model, x, u):
    """d(q, v)/dt from the Hessian of L(q, v) = v^T M v / 2 - V, paper eq. (armdynamics)."""

    def lagrangian(q, v):
        return 0.5 * v @ model.mass_matrix(q) @ v - model.potential_energy(q)

    def acceleration(q, v, u):
        force = model.input_matrix(q) @ u - dissipation(model, q, v)
        mixed = jacrev(grad(lagrangian, 1), 0)(q, v)
        return torch.linalg.solve(
            hessian(lagrangian, 1)(q, v), force + grad(lagrangian, 0)(q, v) - mixed @ v
        )

    q, v = x.chunk(2, -1)
    return torch.cat([v, vmap(acceleration)(q, v, u)], -1)


def hamiltonian_derivative(model, x, u):
    """d(q, p)/dt from the gradient of H(q, p) = p^T W p / 2 + V, paper eq. (hamiltonian_dyn)."""

    def hamiltonian(q, p):
        return 0.5 * p @ model.inverse_mass.matrix(q) @ p + model.potential_energy(q)

    def rates(q, p, u):
        v = grad(hamiltonian, 1)(q, p)
        force = model.input_matrix(q) @ u - dissipation(model, q, v)
        return torch.cat([v, force - grad(hamiltonian, 0)(q, p)])

    return vmap(rates)(*x.chunk(2, -1), u)


def autodiff_derivative(model, x, u):
    """dx/dt in the model's own coordinates."""
    momentum = model.state == "qp"
    return (hamiltonian_derivative if momentum else lagrangian_derivative)(model, x, u)


def rk4_increment(derivative, x, u_start, u_end, step):
    """One step of the four-stage 3/8 rule, the input linear in between."""

    def rate(fraction, increment):
        return derivative(x + increment, u_start + fraction * (u_end - u_start))

    k1 = rate(0, 0)
    k2 = rate(1 / 3, step * k1 / 3)
    k3 = rate(2 / 3, step * (k2 - k1 / 3))
    k4 = rate(1, step * (k1 - k2 + k3))
    return step * (k1 + 3 * k2 + 3 * k3 + k4) / 8


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
