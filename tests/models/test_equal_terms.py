"""Equal terms give equal motion: Lagrangian and Hamiltonian network, and the linear system."""

import copy
from functools import partial

import pytest
import torch

from pinn_dyn.mechanics import Signal
from pinn_dyn.models import (
    FixedCholesky,
    FixedInput,
    NetworkCholesky,
    NetworkPotential,
    Positive,
)
from pinn_dyn.testing import LinearSystem, assert_near, exact_solution
from tests.models.builders import (
    InverseOf,
    input_values,
    make_statistics,
    make_structured,
    positive_matrix,
    random_batch,
)


@pytest.fixture(params=["constant mass", "mass that depends on q"])
def pair(request):
    heads = {
        "constant mass": partial(FixedCholesky, value=positive_matrix(3)),
        # A high floor keeps the masses, and with them the accelerations, moderate.
        "mass that depends on q": partial(
            NetworkCholesky, hidden=[6], positivity=Positive(floor=1.0)
        ),
    }
    lagrangian = make_structured("lnn", mass=heads[request.param])
    mass = copy.deepcopy(lagrangian.mass)
    hamiltonian = make_structured("hnn", mass=lambda _: InverseOf(mass))
    mass.load_state_dict(lagrangian.mass.state_dict())
    for name in ("potential", "damping", "input"):
        getattr(hamiltonian, name).load_state_dict(getattr(lagrangian, name).state_dict())
    return lagrangian.requires_grad_(False), hamiltonian.requires_grad_(False)


def test_both_networks_have_the_same_derivatives(pair):
    lagrangian, hamiltonian = pair
    q, v, _, u = random_batch(3, 3)
    p = lagrangian.momentum(q, v)
    assert_near(hamiltonian.momentum(q, v), p, 1e-9)
    assert_near(hamiltonian.forward_dynamics(q, v, u), lagrangian.forward_dynamics(q, v, u), 1e-9)
    x = torch.cat([q, p], -1)
    assert_near(hamiltonian.state_derivative(x, u), lagrangian.momentum_derivative(x, u), 1e-9)


@pytest.mark.parametrize("kind", ["lnn", "hnn"])
def test_a_network_with_known_terms_is_the_linear_system(kind):
    """Against matrix exponentials: no part of the package is in the expected motion."""
    mass = torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=torch.float64)
    damping, inputs = [[0.5, 0.25], [0.25, 0.75]], input_values(2, 1)
    head = mass if kind == "lnn" else torch.linalg.inv(mass)
    model = make_structured(
        kind,
        2,
        1,
        mass=partial(FixedCholesky, value=((head + head.T) / 2).tolist()),
        potential=partial(NetworkPotential, hidden=[3]),
        damping=partial(FixedCholesky, value=damping),
        input=partial(FixedInput, value=inputs),
    )
    with torch.no_grad():
        for parameter in model.potential.network.parameters():
            parameter.zero_()
        if kind == "hnn":  # beyond the float32 in which a head is built
            model.inverse_mass.factor.copy_(torch.linalg.cholesky(torch.linalg.inv(mass)))
        else:
            model.mass.factor.copy_(torch.linalg.cholesky(mass))
        model.damping.factor.copy_(
            torch.linalg.cholesky(torch.tensor(damping, dtype=torch.float64))
        )
        model.input.value.copy_(torch.tensor(inputs, dtype=torch.float64))
        statistics = make_statistics(2, 1)
        root = model.potential.stiffness_root / statistics.q_std[:, None].float().double()
        stiffness = float(model.potential.scale) * root @ root.T
    system = LinearSystem(mass, stiffness, damping, inputs)
    q, v, _, _ = random_batch(2, 1)
    x0 = torch.cat([q[0], v[0]])
    t = torch.linspace(0, 0.5, 101, dtype=torch.float64)
    u = torch.sin(3 * t)[:, None]
    # The model's potential is centred at the mean of q, the linear system's at zero.
    mean = torch.cat([statistics.q_mean.float().double(), torch.zeros(2, dtype=torch.float64)])
    expected = exact_solution(system, x0 - mean, t, u, "linear") + mean
    start = x0 if kind == "lnn" else torch.cat([q[0], mass @ v[0]])
    with torch.no_grad():
        path = model.predict(start, t, Signal(t, u))
    assert float((expected[:, :2] - expected[:1, :2]).abs().max()) > 0.1
    assert_near(path[:, :2], expected[:, :2], 1e-8)
