"""Rollouts against exact solutions: order, input interpolation, precision, gradients."""

import copy
import itertools

import numpy as np
import pytest
import torch

from pinn_dyn.mechanics import RK4, Rosenbrock, Signal, rollout
from pinn_dyn.mechanics.rollout import path_between
from pinn_dyn.systems import SoftArm
from pinn_dyn.testing import LinearSystem, damped_oscillators, exact_solution

START = torch.tensor([0.5, -0.3, 0.2, 0.8], dtype=torch.float64)


@pytest.fixture
def system():
    return damped_oscillators().requires_grad_(False)


def samples(count, step, seed=0):
    """Times and an input that jumps to an independent value at every sample."""
    generator = torch.Generator().manual_seed(seed)
    t = step * torch.arange(count, dtype=torch.float64)
    return t, torch.randn(count, 1, generator=generator, dtype=torch.float64)


# Against matrix exponentials. RK4 errs by 1e-7 with steps of 0.01 s, a wrong input by 1e-3.


@pytest.mark.parametrize("substeps", [1, 3])
def test_held_input_in_float32_uses_each_intervals_own_sample(system, substeps):
    """0.01 s is no binary fraction: the solver's and the input's times must still agree."""
    t, u = samples(count=51, step=0.01)
    single = copy.deepcopy(system).float()
    x = rollout(
        single.velocity_derivative,
        START.float(),
        t.float(),
        Signal(t.float(), u.float(), "hold"),
        substeps=substeps,
    )
    expected = exact_solution(system, START, t, u, "hold")
    # One stage with a neighbour's input would be off by du h / 8, about 1e-3.
    torch.testing.assert_close(x.double(), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("integrator", [RK4(2), Rosenbrock(1)])
@pytest.mark.parametrize("direction", [-np.inf, np.inf])
def test_times_off_by_a_last_digit_take_the_same_samples_of_a_held_input(
    system, integrator, direction
):
    """As those of a log that another program rounded."""
    system.integrator = integrator
    t, u = samples(11, 0.1)
    towards = torch.tensor(direction, dtype=torch.float64)
    off = torch.cat([t[:1], torch.nextafter(t[1:], towards)])
    exact, found = (system.predict(START, x, Signal(t, u, "hold")) for x in (t, off))
    assert (found - exact).abs().max() < 1e-12


# Order of the method.


@pytest.mark.parametrize("form", ["velocity_derivative", "momentum_derivative"])
def test_rollout_is_of_fourth_order_for_the_soft_arm(form):
    arm = SoftArm()
    q = torch.tensor([0.6, -0.3, 0.2], dtype=torch.float64)
    v = torch.tensor([0.5, 1.0, -0.2], dtype=torch.float64)
    second = v if form == "velocity_derivative" else arm.momentum(q, v)
    x0 = torch.cat([q, second])
    # A straight line over the whole time is exact at every stage.
    t_input = torch.tensor([0.0, 0.05], dtype=torch.float64)
    u = torch.tensor([[0.1, -0.2, -1.3], [-0.2, 0.1, -1.0]], dtype=torch.float64)
    ends = []
    for steps in (8, 16, 32):
        t = torch.linspace(0, 0.05, steps + 1, dtype=torch.float64)
        ends.append(rollout(getattr(arm, form), x0, t, Signal(t_input, u))[-1])
    changes = torch.stack([(b - a).norm() for a, b in itertools.pairwise(ends)])
    ratios = changes[:-1] / changes[1:]
    assert ((ratios > 12) & (ratios < 20)).all(), (changes, ratios)


# Precision of the increments.


def one_step(system, x0, t, u):
    """Increments of one step in float64 and in float32, from the same float32 state."""
    single = copy.deepcopy(system).float()
    exact = path_between(system, RK4(), x0.double(), t, Signal(t, u))[-1]
    rounded = path_between(single, RK4(), x0, t, Signal(t, u.float()))[-1]
    return exact, rounded


@pytest.mark.parametrize("start", [10.0, 1000.0])
def test_increments_keep_float32_precision_late_in_a_recording(system, start):
    """A float32 time of 1000 s resolves 6e-5 s: the step has to be taken in float64."""
    t = start + torch.tensor([0.0, 1e-3], dtype=torch.float64)
    u = torch.ones(2, 1, dtype=torch.float64)
    exact, rounded = one_step(system, torch.tensor([1.0, -1.0, 0.5, 0.2]), t, u)
    assert ((rounded - exact) / exact).abs().max() < 1e-5


class WithActuator(LinearSystem):
    """A drive of first order, dz/dt = (u - z)/lag, whose z moves the masses: a hidden state."""

    lag = 0.3

    def initial_state(self, x0, u0):
        return torch.cat([x0, u0], dim=-1)

    def integrated(self, x, u):
        z = x[..., -1:]
        return torch.cat([self.velocity_derivative(x[..., :-1], z), (u - z) / self.lag], dim=-1)


def test_a_state_of_more_than_q_and_v_stays_inside_the_rollout():
    """The step response of the drive is 1 - exp(-t/lag), which then moves a unit mass."""
    system = WithActuator([[1.0]], [[0.0]], [[0.0]], [[1.0]]).requires_grad_(False)
    system.state_derivative = system.integrated
    t = torch.linspace(0, 1, 101, dtype=torch.float64)
    u = torch.ones(101, 1, dtype=torch.float64)
    u[0] = 0
    x = system.predict(torch.zeros(2, dtype=torch.float64), t, Signal(t, u, "linear"))
    assert x.shape == (101, 2)
    # v = t' - lag (1 - exp(-t'/lag)), delayed by half the first interval's rise.
    late, lag = t[-1] - 0.005, system.lag
    expected = late - lag * (1 - torch.exp(-late / lag))
    assert float(x[-1, 1]) == pytest.approx(float(expected), abs=1e-4)


# Bad input.


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x0": torch.tensor([0.0, torch.nan, 0.0, 0.0])}, r"x0 has 1 non-finite.*index \(1,\)"),
        ({"u": torch.zeros(2, 4, 1)}, r"u has batch shape \(2,\), expected that of x0"),
    ],
)
def test_bad_input_is_refused_by_name(change, message):
    values = {"x0": torch.zeros(4), "t": torch.arange(4.0), "u": torch.zeros(4, 1)} | change
    derivative = copy.deepcopy(damped_oscillators()).float().velocity_derivative
    signal = Signal(torch.arange(4.0), values.pop("u"))
    with pytest.raises(ValueError, match=message):
        rollout(derivative, values.pop("x0"), values.pop("t"), signal, **values)
