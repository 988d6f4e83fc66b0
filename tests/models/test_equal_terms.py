"""Equal terms give equal motion: Lagrangian network, Hamiltonian network, hand-built system."""

import copy
from functools import partial

import pytest
import torch

from pinn_dyn.mechanics import MechanicalSystem, Signal, rollout
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

T = torch.linspace(0, 0.6, 31, dtype=torch.float64)


class HandBuilt(MechanicalSystem):
    """The four terms of a network, everything else by the base class."""

    def __init__(self, network):
        super().__init__(network.num_coordinates, network.num_inputs)
        self.network = network

    def mass_matrix(self, q):
        return self.network.mass_matrix(q)

    def potential_energy(self, q):
        return self.network.potential_energy(q)

    def damping_matrix(self, q):
        return self.network.damping_matrix(q)

    def input_matrix(self, q):
        return self.network.input_matrix(q)


def paths(lagrangian, hamiltonian, t=T, count=4):
    """(q, v) and (q, p) along a rollout from one start under one input, by each network."""
    q, v, _, u = random_batch(lagrangian.num_coordinates, lagrangian.num_inputs, count)
    u = u[:, None] * torch.cos(4 * t)[:, None]
    with torch.no_grad():
        by_velocity = lagrangian.predict(torch.cat([q, v], -1), t, Signal(t, u))
        p = lagrangian.momentum(q, v)
        by_momentum = hamiltonian.predict(torch.cat([q, p], -1), t, Signal(t, u))
    return by_velocity, by_momentum, u


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


def test_both_networks_move_alike(pair):
    lagrangian, hamiltonian = pair
    by_velocity, by_momentum, _ = paths(lagrangian, hamiltonian)
    q, v = by_velocity.chunk(2, -1)
    assert float((q - q[..., :1, :]).abs().max()) > 0.1
    # Two integrations of one motion in two state: they differ by the error of RK4, which
    # falls with the fourth power of the step.
    error = (by_momentum[..., :3] - q).abs().max()
    assert float(error) < 1e-6
    assert_near(hamiltonian.velocity(*by_momentum.chunk(2, -1)), v, 1e-5)


def test_both_networks_have_the_same_derivatives(pair):
    lagrangian, hamiltonian = pair
    q, v, _, u = random_batch(3, 3)
    p = lagrangian.momentum(q, v)
    assert_near(hamiltonian.momentum(q, v), p, 1e-9)
    assert_near(hamiltonian.forward_dynamics(q, v, u), lagrangian.forward_dynamics(q, v, u), 1e-9)
    x = torch.cat([q, p], -1)
    assert_near(hamiltonian.state_derivative(x, u), lagrangian.momentum_derivative(x, u), 1e-9)


def test_networks_move_like_the_base_class_in_the_same_coordinates(pair):
    lagrangian, hamiltonian = pair
    t = T[::5]  # one integrator on both sides: its error is the same
    by_velocity, by_momentum, u = paths(lagrangian, hamiltonian, t)
    system = HandBuilt(lagrangian)
    with torch.no_grad():
        velocity = rollout(system.velocity_derivative, by_velocity[:, 0], t, Signal(t, u))
        momentum = rollout(system.momentum_derivative, by_momentum[:, 0], t, Signal(t, u))
    assert_near(by_velocity, velocity, 1e-9)
    assert_near(by_momentum, momentum, 1e-9)


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
