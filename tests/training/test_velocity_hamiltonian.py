"""A Hamiltonian network on (q, v): the same equations, learned without a momentum."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from pinn_dyn.mechanics import Signal
from pinn_dyn.models import (
    ConstantCholesky,
    ConstantInput,
    HamiltonianNetwork,
    LagrangianNetwork,
    NetworkCholesky,
    NetworkInput,
    NetworkPotential,
    Positive,
)
from pinn_dyn.testing import assert_near
from tests.models.builders import make_statistics, perturb, random_batch

HEADS = dict(
    potential=partial(NetworkPotential, hidden=[6, 5]),
    damping=partial(NetworkCholesky, hidden=[5], positivity=Positive(floor=0.0)),
    input=partial(NetworkInput, hidden=[5]),
)


def make_network(state, n=2, m=2):
    torch.manual_seed(7)
    model = HamiltonianNetwork(
        make_statistics(n, m),
        partial(NetworkCholesky, hidden=[6, 5]),
        **HEADS,
        state=state,
    )
    return perturb(model.double())


def batch():
    q, v, _, u = random_batch(2, 2)
    return torch.cat([q, v], -1), u


def test_it_predicts_the_motion_of_the_same_network_on_momenta():
    on_velocity, on_momentum = make_network("qv"), make_network("qp")
    on_momentum.load_state_dict(on_velocity.state_dict())
    x, u = batch()
    q, v = x.chunk(2, -1)
    t = torch.linspace(0, 0.5, 51, dtype=torch.float64)
    u = u.unsqueeze(1).expand(-1, 51, -1)
    expected = on_velocity.predict(x, t, Signal(t, u))[:, -1]
    ours = on_momentum.predict(torch.cat([q, on_momentum.momentum(q, v)], -1), t, Signal(t, u))[
        :, -1
    ]
    q_end, p_end = ours.chunk(2, -1)
    assert_near(torch.cat([q_end, on_momentum.velocity(q_end, p_end)], -1), expected, 1e-6)
    assert (expected - x).abs().max() > 0.1


def test_its_mass_starts_where_that_of_a_lagrangian_network_does():
    """Without a momentum its scale is that of the accelerations that the inputs give."""
    statistics = replace(make_statistics(3, 3), p_std=torch.ones(3, dtype=torch.float64))
    heads = dict(HEADS, input=ConstantInput)
    ours = HamiltonianNetwork(statistics, ConstantCholesky, **heads, state="qv")
    other = LagrangianNetwork(statistics, ConstantCholesky, **heads)
    q = torch.zeros(1, 3)
    # Both heads start at the same number in units of their scale: a factor for all coordinates.
    ratio = ours.mass_matrix(q)[0].diagonal() / other.mass_matrix(q)[0].diagonal()
    torch.testing.assert_close(ratio, ratio[:1].expand(3))
    assert float(ratio[0].detach()) == pytest.approx(1, rel=0.1)
