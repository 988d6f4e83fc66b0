"""Dry friction never adds energy; angles are periodic."""

from functools import partial

import pytest
import torch
from scipy.integrate import quad

from pinn_dyn.mechanics import Rosenbrock, Signal
from pinn_dyn.models import (
    MLP,
    AccelerationMLP,
    CoulombFriction,
    NetworkCholesky,
    NetworkPotential,
    NextStateMLP,
)
from tests.models.builders import (
    make_scales,
    make_statistics,
    make_structured,
    perturb,
    random_batch,
)
from tests.support.finite_differences import assert_near, slope


def make_friction(size=3, seed=0):
    force, v_std = torch.linspace(0.5, 20.0, size), torch.linspace(0.1, 2.0, size)
    scales = make_scales(size, 1, force, v_std=v_std)
    return perturb(CoulombFriction(scales).double(), seed, 2.0)


@pytest.mark.parametrize("seed", range(5))
def test_friction_opposes_every_velocity(seed):
    """Passive whatever the parameters: v_i F_i(v) >= 0 for slow, fast and zero velocities."""
    friction = make_friction(seed=seed)
    v = torch.logspace(-12, 6, 200, dtype=torch.float64)[:, None].expand(-1, 3)
    for sign in (1.0, -1.0):
        power = friction(sign * v) * sign * v
        assert (power > 0).all()
    assert torch.equal(friction(torch.zeros(1, 3, dtype=torch.float64)), torch.zeros(1, 3).double())


def test_friction_starts_at_the_level_and_the_width_asked_for():
    """c = level times the force and w = (width + 0.01) times the speed."""
    force, v_std = torch.tensor([2.0, 30.0]), torch.tensor([0.5, 4.0])
    friction = CoulombFriction(make_scales(2, 1, force, v_std=v_std), level=0.05, width=0.03)
    torch.testing.assert_close(friction(1e3 * v_std), 0.05 * force)
    width = 0.04 * v_std
    torch.testing.assert_close(friction(width), 0.05 * force * torch.tanh(torch.ones(2)))
    torch.testing.assert_close(friction.slope(torch.zeros(2)), 0.05 * force / width)


def test_friction_is_odd_and_reaches_its_level():
    friction = make_friction()
    _, v, _, _ = random_batch(3, 3)
    assert_near(friction(-v), -friction(v), 1e-14)
    level = friction.force * torch.nn.functional.softplus(friction.raw_force)
    fast = torch.full((3,), 1e3, dtype=torch.float64)
    assert_near(friction(fast), level, 1e-12)


def rubbing_mass():
    """A free mass with friction alone: the model, m, c and w."""
    model = make_structured("lnn", n=1, m=1, friction=CoulombFriction)
    with torch.no_grad():
        for head in (model.potential, model.mass, model.damping):
            for parameter in head.parameters():
                parameter.zero_()
    model.damping.network.linears[-1].bias.data.fill_(-80.0)
    mass = float(model.mass_matrix(torch.zeros(1, 1, dtype=torch.float64)).detach())
    friction = model.friction
    level = float((friction.force * torch.nn.functional.softplus(friction.raw_force)).detach())
    softened = torch.nn.functional.softplus(friction.raw_width) + 0.01
    width = float((friction.v_std * softened).detach())
    return model, mass, level, width


def test_the_rosenbrock_method_takes_steps_far_longer_than_friction():
    """Near rest the speed decays at c/(m w): steps of 20 of its times come to rest all the same."""
    model, mass, level, width = rubbing_mass()
    model.integrator = Rosenbrock()
    t = 20 * mass * width / level * torch.arange(21, dtype=torch.float64)
    x0 = torch.tensor([[0.0, 0.2 * width]], dtype=torch.float64)
    with torch.no_grad():
        v = model.predict(x0, t, Signal(t, torch.zeros(1, 21, 1, dtype=torch.float64)))[0, :, 1]
    assert (v.abs() <= x0[0, 1]).all()
    assert v[-1].abs() < 1e-6 * x0[0, 1]


def test_friction_alone_stops_a_free_mass_and_takes_its_energy():
    """m v' = -c tanh(v/w): sinh(v/w) = sinh(v0/w) exp(-c t/(m w)), a closed form."""
    model, mass, level, width = rubbing_mass()
    t = torch.linspace(0, mass * width / level, 101, dtype=torch.float64)
    v0 = 2 * width
    x0 = torch.tensor([[0.0, v0]], dtype=torch.float64)
    with torch.no_grad():
        x = model.predict(x0, t, Signal(t, torch.zeros(1, 101, 1, dtype=torch.float64)))
    expected = width * torch.asinh(
        torch.sinh(x0[:, 1:] / width) * torch.exp(-level * t / (mass * width))
    )
    assert_near(x[..., 1], expected, 1e-8)
    # What the mass lost is the work of the friction along the way.
    work, _ = quad(lambda v: mass * v, float(x[0, -1, 1]), v0)
    energy = model.total_energy(x[..., :1], x[..., 1:]).detach()
    assert_near(energy[:, 0] - energy[:, -1], torch.tensor([work], dtype=torch.float64), 1e-8)


def test_angles_have_their_period_and_lengths_do_not():
    model = make_structured("lnn", friction=CoulombFriction, angles=[0, 2])
    q, v, _, u = random_batch(3, 3)
    turn = torch.tensor([2.0, 0.0, -4.0], dtype=torch.float64) * torch.pi
    a = model.forward_dynamics(q, v, u)
    assert_near(model.forward_dynamics(q + turn, v, u), a, 1e-11)
    stretched = q + torch.tensor([0.0, 0.5, 0.0], dtype=torch.float64)
    assert (model.forward_dynamics(stretched, v, u) - a).abs().max() > 1e-3
    turned = q + torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64)
    assert (model.forward_dynamics(turned, v, u) - a).abs().max() > 1e-3


@pytest.mark.parametrize("kind", [AccelerationMLP, NextStateMLP])
def test_black_boxes_see_angles_too(kind):
    model = perturb(kind(make_statistics(2, 2), hidden=[6], angles=[1]).double())
    q, v, _, u = random_batch(2, 2)
    t = torch.tensor([0.0, 0.02], dtype=torch.float64)

    def increments(q):
        x0 = torch.cat([q, v], -1)
        return model.increments(x0, t, Signal(t, u[:, None].expand(-1, 2, -1)))

    turn = torch.tensor([0.0, 2 * torch.pi], dtype=torch.float64)
    assert_near(increments(q + turn), increments(q), 1e-11)
    assert (increments(q + turn.flip(0)) - increments(q)).abs().max() > 1e-4


def test_passes_through_angles_are_exact():
    torch.manual_seed(0)
    net = MLP(3, 4, [5], "tanh", torch.tensor([0.1, 0.2, 0.3]), torch.tensor([0.5, 2.0, 1.5]), [1])
    net = net.double()
    x, dx, _, _ = random_batch(3, 3)
    dy = torch.randn(len(x), 4, dtype=torch.float64)
    _, tape = net.linearize(x)
    expected = slope(lambda e: net(x + e * dx), 1e-4)
    tangent = net.pushforward(tape, dx)
    assert_near(tangent, expected, 1e-9)
    # The reverse pass is the adjoint of the tangent pass.
    assert_near((net.pullback(tape, dy) * dx).sum(-1), (dy * tangent).sum(-1), 1e-12)


def test_the_quadratic_well_leaves_angles_out():
    assert NetworkPotential(make_scales(2, 1, angles=[0, 1]), hidden=[4]).stiffness_root is None
    mixed = perturb(NetworkPotential(make_scales(2, 1, angles=[0]), hidden=[4]).double())
    q, _, _, _ = random_batch(2, 2)
    turn = torch.tensor([2 * torch.pi, 0.0], dtype=torch.float64)
    assert_near(mixed(q + turn), mixed(q), 1e-12)
    assert_near(mixed.gradient(q + turn), mixed.gradient(q), 1e-12)


def test_an_angle_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match=r"angles is \[3\], expected positions from 0 to 2"):
        make_structured("lnn", mass=partial(NetworkCholesky, hidden=[4]), angles=[3])
