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
from pinn_dyn.testing import assert_near, slope
from pinn_dyn.training import IncrementLoss
from tests.models.autodiff import lagrangian_derivative, rk4_increment
from tests.models.builders import make_statistics, perturb, random_batch

STEP = 0.05
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


def test_its_state_moves_as_the_lagrangian_of_its_terms_says():
    model = make_network("qv")
    x, u = batch()
    assert_near(model.state_derivative(x, u), lagrangian_derivative(model, x, u), 1e-9)


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


def test_gradients_of_a_step_are_those_of_the_lagrangian_and_finite_differences():
    model = make_network("qv")
    x, u = batch()
    t = torch.tensor([0.0, STEP], dtype=torch.float64)
    statistics = make_statistics(2, 2)
    one_step = replace(statistics, qv_increment_std=statistics.qv_increment_std[:1])
    loss = IncrementLoss(one_step, model).double()
    target = torch.zeros(len(x), 1, 4, dtype=torch.float64)

    def value(increments):
        return loss.error(increments.unsqueeze(1), target)

    def ours():
        return value(model.increments(x, t, Signal(t, torch.stack([u, 0.5 * u], -2)))[..., -1, :])

    def plain():
        rate = partial(lagrangian_derivative, model)
        return value(rk4_increment(rate, x, u, 0.5 * u, STEP))

    parameters = dict(model.named_parameters())
    both = [
        torch.autograd.grad(
            side(), list(parameters.values()), allow_unused=True, materialize_grads=True
        )
        for side in (ours, plain)
    ]
    largest = max(float(g.abs().max()) for g in both[1])
    for (name, parameter), actual, expected in zip(parameters.items(), *both, strict=True):
        assert_near(actual, expected, 1e-8, max(float(expected.abs().max()), 1e-6 * largest))
        flat = parameter.detach().view(-1)
        index = len(flat) // 2
        start = float(flat[index])

        def shifted(e, flat=flat, index=index, start=start):
            flat[index] = start + e
            with torch.no_grad():
                found = ours()
            flat[index] = start
            return found

        difference = abs(float(slope(shifted)) - float(actual.view(-1)[index]))
        assert difference < 1e-7 * largest, name


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
