"""The plants of a closed loop: the contract, SciPy, matrix exponentials, simulators."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from pinn_dyn.control.plants import SimulatorPlant, SystemPlant
from pinn_dyn.systems import SoftArm
from pinn_dyn.testing import LinearSystem, PlantContract, damped_oscillators, exact_solution
from tests.support.closed_loops import Vanishing
from tests.support.contracts import one_case
from tests.support.linear import double
from tests.support.simulated_arms import FINGERS, PANDA, SIMULATORS, simulated_by


def run(plant, q0, v0, inputs, duration):
    """States after each of the inputs, ``(K, steps, 2N)``."""
    plant.start(q0, v0)
    return torch.stack([torch.cat(plant.advance(u, duration), -1) for u in inputs], 1)


def random_arm_states(count):
    q0 = 0.6 * torch.rand(count, 3, generator=torch.manual_seed(0), dtype=torch.float64)
    return q0, q0.flip(-1) - 0.3


def test_soft_arm_moves_as_scipy_says_at_a_tight_tolerance():
    arm = SoftArm()
    q0, v0 = random_arm_states(2)
    inputs = torch.randn(3, 2, 3, generator=torch.manual_seed(1), dtype=torch.float64)
    states = run(SystemPlant(arm, rtol=1e-9, atol=1e-11), q0, v0, inputs, 0.02)
    for k in range(2):
        x = torch.cat([q0[k], v0[k]]).numpy()
        for i, u in enumerate(inputs[:, k]):

            def derivative(t, x, u=u):
                return arm.velocity_derivative(torch.from_numpy(x), u).numpy()

            x = solve_ivp(derivative, (0, 0.02), x, "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
            np.testing.assert_allclose(states[k, i], x, rtol=0, atol=1e-8)


@pytest.mark.parametrize("duration", [0.001, 0.5])
def test_linear_system_moves_as_its_matrix_exponential(duration):
    system = damped_oscillators()
    q0, v0 = double([[0.5, -0.2], [1.0, 2.0]]), double([[0.0, 1.0], [-1.0, 0.3]])
    inputs = torch.randn(5, 2, 1, generator=torch.manual_seed(1), dtype=torch.float64)
    states = run(SystemPlant(system, rtol=1e-9, atol=1e-11), q0, v0, inputs, duration)
    t = duration * torch.arange(6, dtype=torch.float64)
    for k in range(2):
        u = torch.cat([inputs[:, k], inputs[-1:, k]])
        expected = exact_solution(system, torch.cat([q0[k], v0[k]]), t, u, "previous")[1:]
        torch.testing.assert_close(states[k], expected, rtol=0, atol=2e-8)


def test_a_short_remainder_of_an_interval_does_not_stop_the_plant():
    """The arm at rest lets the solver take 0.01 s, which leaves 5e-8 s of the second interval."""
    plant = SystemPlant(SoftArm())
    q = double([[0.0, 0.0, 0.2]])
    plant.start(q, 0 * q)
    for duration in (0.001, 0.01 + 5e-8, 0.01):
        q, v = plant.advance(0 * q, duration)
    assert q.isfinite().all()
    assert v.isfinite().all()


def test_copies_at_rest_do_not_hide_the_error_of_one_that_moves():
    system = LinearSystem([[1.0]], [[100.0]], [[0.0]], [[1.0]])
    q0 = torch.zeros(2_000, 1, dtype=torch.float64)
    q0[0] = 1.0
    q = run(SystemPlant(system, rtol=1e-5), q0, 0 * q0, [0 * q0] * 5, 0.5)[0, :, 0]
    expected = torch.cos(10 * 0.5 * torch.arange(1, 6, dtype=torch.float64))
    torch.testing.assert_close(q, expected, rtol=0, atol=3e-4)


def test_a_copy_that_loses_its_mass_matrix_is_nan_and_the_others_go_on():
    q0, v0 = double([[0.0], [0.0], [0.5]]), double([[-0.1], [3.0], [-0.2]])
    inputs = [torch.zeros(3, 1, dtype=torch.float64)] * 10
    states = run(SystemPlant(Vanishing()), q0, v0, inputs, 0.05)
    # Without forces (1 - q) v^2 is constant: 1.5 v0 t = 1 - (1 - q)^1.5 for q0 = 0.
    assert states[1, :4].isfinite().all()
    assert states[1, 4:].isnan().all()
    expected = 1 - (1 - 1.5 * 3.0 * 0.05 * torch.arange(1, 5, dtype=torch.float64)) ** (2 / 3)
    torch.testing.assert_close(states[1, :4, 0], expected, rtol=0, atol=1e-5)
    others = run(SystemPlant(Vanishing()), q0[[0, 2]], v0[[0, 2]], [u[:2] for u in inputs], 0.05)
    torch.testing.assert_close(states[[0, 2]], others, rtol=0, atol=1e-6)


@pytest.fixture(params=SIMULATORS)
def panda(request):
    return simulated_by(request.param)(PANDA, locked_joints=FINGERS, damping=0.5)


def panda_states(panda):
    rng = np.random.default_rng(0)
    q0 = torch.from_numpy(rng.uniform(panda.q_low, panda.q_high, (2, 7)))
    return q0, torch.from_numpy(rng.uniform(-1, 1, (2, 7))), rng.uniform(-5, 5, (6, 2, 7))


def test_copies_move_as_in_a_rollout_of_the_simulator(panda):
    q0, v0, inputs = panda_states(panda)
    states = run(SimulatorPlant(panda, step=0.001), q0, v0, torch.from_numpy(inputs), 0.003)
    for k in range(2):
        panda.set_state(q0[k].numpy(), v0[k].numpy())
        steps = [np.concatenate(panda.step(inputs[i // 3, k], 0.001)) for i in range(18)]
        np.testing.assert_allclose(states[k], steps[2::3], rtol=0, atol=1e-9)


def test_a_simulator_refuses_a_time_between_its_steps(panda):
    q0, v0, inputs = panda_states(panda)
    plant = SimulatorPlant(panda, step=0.001)
    plant.start(q0, v0)
    with pytest.raises(ValueError, match=r"integer multiple .* change the rate or the step"):
        plant.advance(torch.from_numpy(inputs[0]), 0.0025)
    for step, duration in ((0.001, 0.003), (0.0005, 0.0025)):
        states = run(SimulatorPlant(panda, step=step), q0, v0, torch.from_numpy(inputs), duration)
        assert states.isfinite().all()


@one_case
class TestSystemPlant(PlantContract):
    @pytest.fixture(params=[damped_oscillators, SoftArm], ids=["oscillators", "soft arm"])
    def plant(self, request):
        return SystemPlant(request.param())


@one_case
class TestSimulatorPlant(PlantContract):
    @pytest.fixture
    def plant(self, panda):
        return SimulatorPlant(panda, step=0.001)
