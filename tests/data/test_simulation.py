"""The simulator against closed forms, a second solver and the balance of energy."""

import numpy as np
import pytest
import torch
from scipy.integrate import cumulative_simpson, solve_ivp

from pinn_dyn.data import Mixture, MultiSine, SimulationError, Steps, simulate
from pinn_dyn.systems import SoftArm
from pinn_dyn.testing import damped_oscillators
from tests.support.closed_loops import Vanishing
from tests.support.code_in_c import build_at_once, codes
from tests.support.linear import exact_solution_under_sine

ARM_INPUTS = Mixture(
    [
        MultiSine([0.0, 0.0, -1.15], [1.2, 1.2, 0.1], frequency=[0.5, 2.0], harmonics=3),
        Steps([0.0, 0.0, -1.15], [1.2, 1.2, 0.1], hold=[0.2, 0.5], rise_time=0.1),
    ]
)
ARM_Q = np.array([[0.6, -0.4, 0.2], [-0.9, 0.3, 0.3], [0.1, 0.05, 0.15]])
ARM_V = np.array([[0.5, -0.2, 0.05], [0.0, 0.0, 0.0], [-0.8, 0.9, -0.05]])
ARM_T = np.linspace(0, 1.0, 501)


def constant(value, count):
    return lambda t: np.tile(np.asarray(value), (count, len(t), 1))


@pytest.fixture
def linear():
    return damped_oscillators().requires_grad_(False)


@pytest.fixture(scope="module")
def arm_run():
    signal = ARM_INPUTS.draw(3, 1.0, np.random.default_rng(0))
    q, v = simulate(SoftArm(), ARM_Q, ARM_V, signal, ARM_T)
    return signal, q, v


@pytest.mark.parametrize(("tolerance", "error"), [(1e-8, 1e-7), (1e-11, 1e-9)])
def test_a_damped_linear_system_follows_the_matrix_exponential(linear, tolerance, error):
    x0 = torch.tensor([0.5, -0.3, 0.2, 0.8], dtype=torch.float64)
    t = np.linspace(0, 4, 41)
    q, v = simulate(
        linear,
        x0[None, :2].numpy(),
        x0[None, 2:].numpy(),
        lambda s: np.sin(3 * s)[None, :, None],
        t,
        rtol=tolerance,
        atol=tolerance,
    )
    exact = exact_solution_under_sine(linear, x0, torch.from_numpy(t), 3.0)
    np.testing.assert_allclose(np.hstack([q[0], v[0]]), exact.numpy(), rtol=0, atol=error)


def test_without_a_compiler_the_simulation_runs(linear, monkeypatch):
    monkeypatch.setenv("PATH", "")
    q0, v0, t = np.ones((2, 2)), np.zeros((2, 2)), np.linspace(0, 1, 5)
    plain = simulate(linear, q0, v0, constant([1.0], 2), t)
    np.testing.assert_array_equal(
        simulate(linear, q0, v0, constant([1.0], 2), t, compile=True), plain
    )


def test_code_in_c_gives_the_same_motion(monkeypatch, tmp_path):
    build_at_once(monkeypatch, tmp_path)
    arm, t = SoftArm(), np.linspace(0, 0.2, 5)
    at = arm, np.full((3, 3), 0.1), np.zeros((3, 3)), constant([0.1, 0.2, -1.0], 3), t
    in_c = simulate(*at, compile=True)
    assert codes()
    np.testing.assert_allclose(in_c, simulate(*at), rtol=0, atol=1e-7)


def test_the_soft_arm_agrees_with_a_tighter_solve_of_one_trajectory(arm_run):
    signal, q, v = arm_run
    arm = SoftArm()

    def rate(time, x):
        u = torch.from_numpy(signal(np.array([time]))[0, 0])
        with torch.inference_mode():
            return arm.velocity_derivative(torch.from_numpy(np.array(x)), u).numpy()

    every = slice(None, None, 50)
    tight = solve_ivp(
        rate,
        (0, 0.5),
        np.concatenate([ARM_Q[0], ARM_V[0]]),
        method="DOP853",
        t_eval=ARM_T[:251][every],
        rtol=1e-11,
        atol=1e-12,
    )
    ours = np.hstack([q[0], v[0]])[:251][every]
    np.testing.assert_allclose(ours, tight.y.T, rtol=0, atol=1e-6)


def test_the_energy_of_the_soft_arm_changes_by_the_power_that_enters_and_is_lost(arm_run):
    signal, q, v = arm_run
    arm = SoftArm()
    q, v, u = (torch.from_numpy(np.ascontiguousarray(x)) for x in (q, v, signal(ARM_T)))
    energy = arm.total_energy(q, v).numpy()
    work = cumulative_simpson(arm.power(q, v, u).numpy(), x=ARM_T, initial=0)
    change = energy - energy[:, :1]
    np.testing.assert_allclose(change, work, rtol=0, atol=2e-6)
    assert np.abs(change).max() > 0.05


def jumping(q):
    return torch.where(q < 1, torch.ones_like(q), -torch.ones_like(q))


def push(mass, q0):
    t = np.linspace(0, 5, 51)
    simulate(Vanishing(mass), np.full((1, 1), q0), np.zeros((1, 1)), constant([1.0], 1), t)


def time_of(error):
    return float(str(error).split("t = ")[1].split(" s")[0])


def test_a_mass_matrix_that_is_not_positive_ends_the_simulation_and_says_when():
    """q = t^2/2 reaches 1 after sqrt(2) s; the time named is that of the last good step."""
    with pytest.raises(SimulationError, match="matrix is no longer positive") as caught:
        push(jumping, 0.0)
    assert time_of(caught.value) == pytest.approx(np.sqrt(2), abs=2e-3)


def test_an_input_that_stops_being_a_number_ends_the_simulation(linear):
    def signal(t):
        return np.where(t < 0.5, 0.1, np.nan)[None, :, None]

    with pytest.raises(SimulationError) as caught:
        simulate(linear, np.zeros((1, 2)), np.zeros((1, 2)), signal, np.linspace(0, 1, 11))
    assert time_of(caught.value) == pytest.approx(0.5, abs=1e-3)


# Limits of the configuration.


def test_a_motion_that_leaves_its_limits_is_held_and_the_others_go_on(linear):
    """Against the same motions without limits: equal until one leaves, and NaN from then on."""
    q0, v0 = np.array([[0.5, -0.3], [0.1, 0.0]]), np.array([[2.0, 0.8], [0.0, 0.0]])
    t = np.linspace(0, 4, 401)
    limits = np.array([[-0.6, -0.6], [0.6, 0.6]])
    free_q, free_v = simulate(linear, q0, v0, constant([0.1], 2), t)
    q, v = simulate(linear, q0, v0, constant([0.1], 2), t, q_limits=limits)
    leaves = int(np.argmax((np.abs(free_q[0]) > 0.6).any(-1)))
    assert 0 < leaves < 50
    assert np.abs(free_q[1]).max() < 0.6
    np.testing.assert_allclose(q[1], free_q[1], rtol=0, atol=1e-6)
    np.testing.assert_allclose(v[1], free_v[1], rtol=0, atol=1e-6)
    np.testing.assert_allclose(q[0, : leaves + 1], free_q[0, : leaves + 1], rtol=0, atol=1e-6)
    assert np.isnan(q[0, leaves + 50 :]).all()
    assert np.isnan(v[0, leaves + 50 :]).all()


def test_a_simulation_that_all_motions_have_left_ends(linear):
    q, _ = simulate(
        linear,
        np.full((2, 2), 0.7),
        np.zeros((2, 2)),
        constant([0.0], 2),
        np.linspace(0, 1e6, 11),
        q_limits=np.array([[-0.6, -0.6], [0.6, 0.6]]),
    )
    assert np.isnan(q[:, 1:]).all()
