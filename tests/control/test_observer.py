"""The disturbance observer, against closed forms and against the loop without it."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from torch import nn

from pinn_dyn.control import Motion, Pipeline, Plant, close_loop
from pinn_dyn.control.effects import Actuator
from pinn_dyn.control.laws import Regulation, Tracking
from pinn_dyn.control.observer import DisturbanceObserver
from pinn_dyn.control.plants import SystemPlant
from pinn_dyn.control.references import SetPoint, Sines
from pinn_dyn.testing import ControllerContract, LinearSystem, assert_near
from pinn_dyn.testing.controller import input_of, states
from tests.support.cart_pole import CartPole
from tests.support.linear import double

ZERO = np.zeros((2, 2))
MASS = np.array([[2.0, 0.5], [0.5, 1.0]])
INPUTS = np.array([[1.0, 0.3], [-0.2, 0.8]])


def free_masses(factor=1.0):
    """M dv/dt = A u: momentum grows by the impulse of the input, exactly."""
    return LinearSystem(factor * MASS, ZERO, ZERO, INPUTS)


class PushedCartPole(CartPole):
    """Cart-poles under constant forces d ``(K, 2)``, which enter as a potential."""

    def __init__(self, push):
        super().__init__()
        self.push = nn.Parameter(double(push))

    def potential_energy(self, q):
        return super().potential_energy(q) - (q * self.push).sum(-1)


class ExactPlant(Plant):
    """A linear system under held inputs and a constant force, moved by matrix exponentials."""

    def __init__(self, system, push=(0.0, 0.0)):
        self.num_coordinates, self.num_inputs = system.num_coordinates, system.num_inputs
        f, b = system.state_space()
        inverse = np.linalg.inv(system.mass.detach().numpy())
        self.slope = np.hstack([f, b, np.vstack([np.zeros((2, 1)), inverse @ np.c_[list(push)]])])

    def start(self, q0, v0):
        self.x = torch.cat([q0, v0], dim=-1)

    def advance(self, u, duration):
        n = len(self.slope[0])
        flow = expm(duration * np.vstack([self.slope, np.zeros((n - 4, n))]))[:4]
        one = torch.ones_like(self.x[:, :1])
        self.x = torch.cat([self.x, u, one], dim=-1) @ torch.from_numpy(flow).T
        return self.x.clone().tensor_split(2, dim=-1)


def run(plant, law, reference, *, duration, rate, q0=None, **effects):
    start = reference(0.0)
    q0 = start.q if q0 is None else double(q0)
    q0, v0 = q0.expand(1, -1).clone(), start.v.expand(1, -1).clone()
    return close_loop(plant, law, reference, q0, v0, duration=duration, rate=rate, **effects)


def residuals(observer, plant, period, steps, push=(0.0, 0.0)):
    """Free masses under the observer's input, moved exactly; r after each call, ``(steps, 2)``."""
    inverse = torch.linalg.inv(double(MASS))
    goal = Motion(double([0.3, -0.2]), *torch.zeros(2, 2, dtype=torch.float64))
    q, v = torch.zeros(2, 2, dtype=torch.float64)
    pipeline, found = Pipeline(observer, period), []
    memory = torch.zeros(pipeline.memory_size).double()
    for _ in range(steps):
        u, _, memory = pipeline(q, v, *goal, memory)
        found.append(residual_of(memory))
        a = inverse @ (double(INPUTS) @ u + double(push))
        q, v = q + period * v + 0.5 * period**2 * a, v + period * a
    return torch.stack(found)


def residual_of(memory, inputs=2):
    """The residual r, after the marks of the pipeline and the observer and the last input."""
    return memory[..., 2 + inputs : 4 + inputs]


# The residual.


def test_the_residual_goes_to_a_constant_disturbance_with_time_constant_one_over_bandwidth():
    system, push, period, bandwidth = free_masses(), [0.7, -1.3], 0.01, 12.0
    observer = DisturbanceObserver(Regulation(system, 3.0, 2.0), bandwidth)
    found = residuals(observer, system, period, 60, push)
    t = period * torch.arange(60, dtype=torch.float64)
    assert_near(found, (1 - torch.exp(-bandwidth * t))[:, None] * double(push), 1e-10)


def test_the_input_is_that_of_the_law_less_what_undoes_the_residual():
    system = free_masses()
    law = Regulation(system, 3.0, 2.0)
    pipeline = Pipeline(DisturbanceObserver(law, 12.0), 0.01)
    q, v, motion = states(2)
    memory = torch.zeros(6, pipeline.memory_size).double()
    for _ in range(3):
        result = pipeline.call(q, v, motion, memory)
        memory = result.memory
    expected = np.linalg.solve(INPUTS, residual_of(memory).numpy().T).T
    difference = input_of(law, q, v, motion) - result.u
    np.testing.assert_allclose(difference, expected, rtol=1e-10)
    assert np.abs(expected).min() > 1e-3
    size = result.report["compensation"].numpy()
    np.testing.assert_allclose(size, np.linalg.norm(expected, axis=-1))


class Turned(LinearSystem):
    """Free masses with inputs that turn with q."""

    def input_matrix(self, q):
        return torch.cos(q[..., :1, None]) * self.inputs


def test_the_input_of_a_period_acts_by_the_mean_of_both_input_matrices():
    system, period, bandwidth = Turned(MASS, ZERO, ZERO, INPUTS), 0.1, 12.0
    pipeline = Pipeline(DisturbanceObserver(Regulation(system, 3.0, 2.0), bandwidth), period)
    q, v, motion = states(2)
    goal = Motion(*(x[0] for x in motion))
    memory = torch.zeros(pipeline.memory_size).double()
    u, _, memory = pipeline(q[0], v[0], *goal, memory)
    _, _, memory = pipeline(q[1], v[1], *goal, memory)
    turned = 0.5 * (torch.cos(q[0, 0]) + torch.cos(q[1, 0]))
    disturbance = double(MASS) @ (v[1] - v[0]) / period - turned * double(INPUTS) @ u
    expected = (1 - np.exp(-bandwidth * period)) * disturbance
    assert_near(residual_of(memory), expected, 1e-10)


def test_on_a_nonlinear_system_the_residual_is_the_force_that_the_model_misses():
    """All terms are at work; what is left is the trapezoidal rule's error, of second order."""
    bandwidth, errors = 15.0, []
    pushes = [[0.0, 0.0], [0.4, 0.25]]
    plant = SystemPlant(PushedCartPole(pushes), rtol=1e-6, atol=1e-8)
    for rate in (50.0, 100.0):
        observer = DisturbanceObserver(Regulation(CartPole(), 8.0, 1.0), bandwidth)
        reference = SetPoint([0.3, 0.4])
        q0 = double([[-0.4, 1.2]] * 2)
        record = close_loop(plant, observer, reference, q0, 0 * q0, duration=0.6, rate=rate)
        assert record.v.abs().amax((1, 2)).min() > 2
        pipeline, motion = Pipeline(observer, 1 / rate), reference(0.0)
        memory = torch.zeros(2, pipeline.memory_size).double()
        for k in range(len(record.t)):
            _, _, memory = pipeline(record.q[:, k], record.v[:, k], *motion, memory)
        expected = (1 - np.exp(-bandwidth * 0.6)) * double(pushes)
        errors.append((residual_of(memory, 1) - expected).abs().amax(-1))
    assert (errors[0] < 5e-3).all()
    assert (errors[1] < errors[0] / 3).all()


def test_limits_that_are_known_are_not_taken_for_a_disturbance():
    system, reference = free_masses(), SetPoint([3.0, -2.0])
    plant = ExactPlant(system)
    limits = {"low": -1.5, "high": [1.0, 2.0], "rate": 100.0}
    observer = DisturbanceObserver(Regulation(system, 40.0, 5.0), 30.0)
    settings = dict(duration=0.3, rate=100.0, q0=[0.0, 0.0])
    record = run(plant, observer, reference, actuator=Actuator(**limits), **settings)
    assert record.diagnostics["saturated_inputs"].sum() > 10
    assert record.diagnostics["compensation"].max() < 1e-8


# The closed loop.


def test_a_wrong_model_tracks_far_better_with_the_observer():
    """The model lacks a third of the mass, all of the friction and a load."""
    plant = ExactPlant(LinearSystem(1.5 * MASS, 3 * np.eye(2), 2 * np.eye(2), INPUTS), [0.5, 0.2])
    model = LinearSystem(MASS, 3.3 * np.eye(2), ZERO, INPUTS)
    reference = Sines([0.3, -0.2], [0.4, 0.3], [0.5, 0.8])
    law = Tracking(model, 40.0, 8.0)
    errors = []
    for controller in (law, DisturbanceObserver(law, 100.0)):
        record = run(plant, controller, reference, duration=1.0, rate=250.0)
        errors.append((record.q - record.reference.q).square().mean().sqrt().item())
    assert errors[1] < errors[0] / 15


@pytest.mark.parametrize(("factor", "stable"), [(0.3, True), (1.8, True), (2.2, False)])
def test_a_fast_observer_is_stable_for_models_below_twice_the_mass(factor, stable):
    """a = 1 - exp(-K_O T) is 1 here: the residual's factor per period is 1 - M_L / M."""
    observer = DisturbanceObserver(Regulation(free_masses(factor), 1e-3, 1e-3), 1e4)
    found = residuals(observer, free_masses(), 0.01, 60, [0.7, -1.3])
    changes = (found[1:] - found[:-1]).norm(dim=-1)
    assert bool(changes[-1] < 1e-3 * changes[0]) == stable
    if not stable:
        assert changes[-1] > 1e3 * changes[0]


def test_the_limited_rate_bounds_what_would_grow():
    """The unstable case above: now each entry of r steps by max_rate T at most, about the truth."""
    law = Regulation(free_masses(2.2), 1e-3, 1e-3)
    observer = DisturbanceObserver(law, 1e4, max_rate=5.0)
    found = residuals(observer, free_masses(), 0.01, 100, [0.7, -1.3])
    assert (found[1:] - found[:-1]).abs().max() == pytest.approx(0.05)
    assert_near(found[:14, 0], 0.05 * torch.arange(14, dtype=torch.float64), 1e-12)
    # M_L dv/dt = A u_law + d_L with d_L = 2.2 d - 1.2 r is at rest at r = d.
    assert (found[50:] - double([0.7, -1.3])).abs().max() < 0.06


# The contract, memory and errors.


class TestOnTheCartPole(ControllerContract):
    @pytest.fixture
    def controller(self):
        law = Tracking(CartPole(), 5.0, 1.0)
        return DisturbanceObserver(law, 50.0, max_rate=30.0)
