"""A learned initial velocity: where rollouts start, how it is trained, and what refuses it."""

from functools import partial

import pytest
import torch

from pinn_dyn.data import draw_windows
from pinn_dyn.mechanics import RK4, Rosenbrock, Signal, Trajectory, rollout
from pinn_dyn.models import AccelerationMLP, LearnedVelocity, Scales
from pinn_dyn.testing import LinearSystem, damped_oscillators, exact_solution
from pinn_dyn.training import IncrementLoss, MidpointLoss
from tests.models.builders import STEP, make_scales, make_statistics, make_structured, perturb


class Started(LinearSystem):
    """A linear system that starts at the velocity of a head."""

    learns_initial_state = True

    def __init__(self, system, head):
        super().__init__(system.mass, system.stiffness, system.damping, system.inputs)
        self.head = head

    def initial_state(self, x0, u0):
        q, v = x0.chunk(2, -1)
        return torch.cat([q, self.head(q, v, u0)], -1)


LEARNED = partial(LearnedVelocity, hidden=[5])


def motion(seed=0):
    generator = torch.Generator().manual_seed(seed)
    t = STEP * torch.arange(4, dtype=torch.float64)
    x0 = 0.3 * torch.randn(5, 4, generator=generator, dtype=torch.float64)
    return x0, t, torch.randn(5, 4, 2, generator=generator, dtype=torch.float64)


INTEGRATORS = {"rk4": RK4(), "rosenbrock": Rosenbrock()}


def started(kind):
    """A model whose head is as it could be after training."""
    if kind == "acceleration":
        torch.manual_seed(7)
        model = AccelerationMLP(make_statistics(2, 2), hidden=[6], initial_velocity=LEARNED)
        return perturb(model.double())
    return make_structured("lnn", 2, 2, initial_velocity=LEARNED, integrator=INTEGRATORS[kind])


def untrained(model):
    """With the last layer of the head as it starts, zero."""
    for parameter in model.initial_velocity.network.linears[-1].parameters():
        torch.nn.init.zeros_(parameter)
    return model


def test_before_training_rollouts_start_at_the_measured_velocity():
    head = LearnedVelocity(make_scales(2, 2, [1.0, 1.0]))
    x0, _, u = (value.float() for value in motion())
    q, v = x0.chunk(2, -1)
    assert torch.equal(head(q, v, u[:, 0]), v)


@pytest.mark.parametrize("kind", ["rk4", "rosenbrock", "acceleration"])
def test_a_rollout_starts_there_and_counts_from_the_measured_state(kind):
    model, plain = started(kind), untrained(started(kind))
    plain.load_state_dict(
        {k: v for k, v in model.state_dict().items() if "initial_velocity" not in k}, strict=False
    )
    x0, t, u = motion()
    q, v = x0.chunk(2, -1)
    start = torch.cat([q, model.initial_velocity(q, v, u[:, 0])], -1)
    assert (start - x0).abs().max() > 0.1
    found = model.predict(x0, t, Signal(t, u))
    torch.testing.assert_close(found[:, 1:], plain.predict(start, t, Signal(t, u))[:, 1:])
    assert torch.equal(found[:, 0], x0)
    if kind == "rk4":
        torch.testing.assert_close(
            found[:, 1:], rollout(model.state_derivative, start, t, Signal(t, u))[:, 1:]
        )


def test_a_wrong_measured_velocity_is_mended():
    """The true dynamics from 0.6 v: the head alone can lower the loss, and finds v."""
    system = damped_oscillators()
    t = torch.linspace(0, 6, 301, dtype=torch.float64)
    u = torch.sin(2.5 * t[:, None])
    x = exact_solution(system, torch.tensor([0.4, -0.3, 0.5, 0.8]).double(), t, u, "linear")
    q, v = x.chunk(2, -1)
    windows = draw_windows(
        [Trajectory(q, 0.6 * v, Signal(t, u))], count=200, steps=3, stride=5, seed=0
    )
    statistics = windows.statistics()
    torch.manual_seed(0)
    head = LearnedVelocity(Scales(statistics, statistics.v_std), hidden=[8]).double()
    started = Started(system, head)
    loss = IncrementLoss(statistics, started, velocity_weight=1e-6).double()
    optimizer = torch.optim.Adam(head.parameters(), lr=0.04)
    first = loss(started, windows).item()
    for _ in range(80):
        optimizer.zero_grad()
        value = loss(started, windows)
        value.backward()
        optimizer.step()
    assert value.item() < 0.01 * first
    found = head(windows.q, windows.v, windows.u[:, 0])
    true = windows.v / 0.6
    assert (found - true).norm() < 0.15 * (windows.v - true).norm()


def test_one_step_windows_teach_it_by_their_configuration():
    """Elsewhere q of one step is left out, as dq/dt = v holds by construction."""
    model = make_structured("lnn", 1, 1, initial_velocity=LEARNED)
    statistics = make_statistics(1, 1)
    assert IncrementLoss(statistics, model).exact_coordinates == 0
    assert IncrementLoss(statistics, make_structured("lnn", 1, 1)).exact_coordinates == 1


def test_a_loss_without_a_rollout_refuses_it():
    model = make_structured("lnn", 2, 2, initial_velocity=LEARNED)
    with pytest.raises(ValueError, match=r"has no rollout.*~model/initial_velocity"):
        MidpointLoss(make_statistics(2, 2), model)
