"""Predictive control: optimal plans, limits, failures, references ahead of time."""

import copy

import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_are
from scipy.optimize import lsq_linear

from pinn_dyn.control import (
    Actuator,
    Pipeline,
    PointToPoint,
    PredictiveControl,
    Regulation,
    SetPoint,
    SystemPlant,
    close_loop,
)
from pinn_dyn.testing.controller import input_of
from pinn_dyn.testing.linear_system import damped_oscillators
from tests.support.linear import Pendulums, double

pytest.importorskip("casadi")
STEP = 0.05


def pendulum(mass=1.0, kind=Pendulums):
    """A point mass on a rod of 0.5 m, driven by a motor; q = 0 hangs."""
    return kind([[mass / 4]], [[9.81 * mass / 2]], [[0.1]], [[1.0]])


def run(law, reference=None, *, q0=0.0, v0=0.0, duration=1.0, mass=1.0, actuator=None):
    reference = reference or SetPoint([1.0])
    start = double([[q0]]), double([[v0]])
    arguments = {"duration": duration, "rate": 1 / STEP, "actuator": actuator}
    return close_loop(SystemPlant(pendulum(mass)), law, reference, *start, **arguments)


@pytest.fixture(scope="module")
def law():
    return PredictiveControl(pendulum(), 0.6, STEP, input_weight=1e-2, velocity_weight=0.01)


def linear_problem():
    """Return A, B of the midpoint rule, for two coupled springs."""
    F, B = damped_oscillators().state_space()
    left = np.linalg.inv(np.eye(4) - STEP / 2 * F)
    return left @ (np.eye(4) + STEP / 2 * F), left @ (STEP * B)


def test_without_limits_it_is_the_linear_quadratic_regulator():
    system, x = damped_oscillators().requires_grad_(False), np.array([0.3, -0.2, 0.5, 0.1])
    law = PredictiveControl(system, 0.3, STEP, velocity_weight=0.2, input_weight=0.05)
    A, B = linear_problem()
    Q, R = STEP * np.diag([1, 1, 0.2, 0.2]), STEP * 0.05 * np.eye(1)
    P = solve_discrete_are(A, B, Q, R)
    gain = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    u = input_of(law, *torch.from_numpy(x).split(2), SetPoint([0.0, 0.0])(0.0))
    np.testing.assert_allclose(u, -gain @ x, rtol=1e-5)


def test_with_limits_it_is_the_bounded_least_squares_solution():
    system, x = damped_oscillators().requires_grad_(False), np.array([2.0, -1.0, 0.5, 0.1])
    steps, high = 8, 1.5
    settings = {"terminal_weight": 2.0, "actuator": Actuator(-high, high)}
    law = PredictiveControl(system, steps * STEP, STEP, input_weight=1e-2, **settings)
    A, B = linear_problem()
    free = [np.linalg.matrix_power(A, k + 1) @ x for k in range(steps)]
    forced = np.zeros((steps, 4, steps))
    for k in range(steps):
        for j in range(k + 1):
            forced[k, :, j] = (np.linalg.matrix_power(A, k - j) @ B)[:, 0]
    weight = np.tile([1, 1, 0.1, 0.1], (steps, 1)) * STEP
    weight[-1] = 2.0 * np.array([1, 1, 0.1, 0.1])
    rows = np.sqrt(weight).reshape(-1, 1) * forced.reshape(-1, steps)
    rows = np.vstack([rows, np.sqrt(STEP * 1e-2) * np.eye(steps)])
    right = np.concatenate([-np.sqrt(weight).ravel() * np.ravel(free), np.zeros(steps)])
    optimum = lsq_linear(rows, right, (-high, high), tol=1e-12).x
    assert (np.abs(optimum) > high - 1e-6).sum() in range(1, steps)
    q, v = torch.from_numpy(x).split(2)
    memory, zero = torch.zeros(law.memory_size).double(), torch.zeros(1).double()
    _, memory, _ = law.step(q, v, SetPoint([0.0, 0.0])(0.0), zero, memory)
    np.testing.assert_allclose(memory[-steps:], optimum, atol=1e-4)


def test_it_respects_the_limits_and_beats_the_clipped_law():
    actuator = Actuator(-6.0, 6.0, rate=60.0)
    settings = {"input_weight": 1e-3, "velocity_weight": 0.01, "v_max": 2.0, "actuator": actuator}
    planned = run(PredictiveControl(pendulum(), 0.6, STEP, **settings), duration=1.5)
    clipped = run(Regulation(pendulum(), 20.0, 1.0), duration=1.5, actuator=actuator)
    assert planned.u.abs().max() <= 6.0
    assert planned.u.diff(dim=1).abs().max() <= 60.0 * STEP + 1e-6
    assert planned.u[0, 0].abs() <= 60.0 * STEP + 1e-6  # from zero
    assert 1.8 < planned.v.max() < 2.05
    assert clipped.v.max() > 2.2
    assert (planned.q - 1).abs()[0, -6:].max() < 1e-2 < (clipped.q - 1).abs()[0, -6:].max()
    assert planned.diagnostics["solver_failed"].sum() == 0


def test_limits_hold_on_both_sides_and_at_a_rate_above_that_of_the_plan():
    actuator = Actuator(-6.0, 6.0, rate=60.0)
    settings = {"velocity_weight": 0.01, "q_low": -0.8, "v_max": 2.0, "actuator": actuator}
    law = PredictiveControl(pendulum(), 0.6, STEP, **settings)
    start = double([[0.0]]), double([[0.0]])
    loop = {"duration": 1.0, "rate": 2 / STEP}
    record = close_loop(SystemPlant(pendulum()), law, SetPoint([-1.0]), *start, **loop)
    assert not record.diagnostics["solver_failed"].any()
    assert record.u.diff(dim=1).abs().max() <= 60.0 * STEP / 2 + 1e-6
    assert -2.05 < record.v.min() < -1.8
    assert -0.81 < record.q.min() < -0.79


def test_a_new_run_forgets_the_previous_run(law):
    first, second = run(law, duration=0.5), run(law, duration=0.5)
    torch.testing.assert_close(first.u, second.u, rtol=0, atol=0)


def test_it_sees_the_reference_ahead_of_time(law):
    move = PointToPoint([0.0], [1.5], duration=0.5, begin=0.3)
    without = copy.copy(law)
    without.ahead = (0.0,)
    errors = [(x.q - x.reference.q).abs().max() for x in (run(law, move), run(without, move))]
    assert errors[0] < 0.5 * errors[1]


def test_the_observer_removes_the_steady_error_of_a_wrong_model(law):
    wrong, exact = run(law, mass=1.2, duration=2.0), run(law)
    observed = PredictiveControl(
        pendulum(), 0.6, STEP, input_weight=1e-2, velocity_weight=0.01, observer_bandwidth=10.0
    )
    corrected = run(observed, mass=1.2, duration=2.0)
    assert (corrected.q - 1)[0, -1].abs() < 1e-3 < 0.02 < (wrong.q - 1)[0, -1].abs()
    assert (run(observed).q - exact.q).abs().max() < 5e-3


def test_a_failed_solver_holds_the_last_input_and_stops_after_a_horizon(law, monkeypatch):
    solve = law.problem.solve

    def failing(x, u0, *rest, **settings):
        if calls.append(0) or len(calls) > 5:
            raise FloatingPointError
        return solve(x, u0, *rest, **settings)

    calls = []
    monkeypatch.setattr(law.problem, "solve", failing)
    record = run(law, duration=1.5)
    failed = record.diagnostics["solver_failed"][0].nan_to_num(1.0)
    assert failed[:5].sum() == 0
    assert failed[5:].all()
    assert record.u[0, 4] != record.u[0, 3]
    assert (record.u[0, 4:17] == record.u[0, 4]).all()
    assert "the solver found no plan for longer than the horizon" in record.stopped[0]


def test_a_start_without_a_feasible_plan_names_the_limit(caplog):
    settings = {"q_high": 0.5, "actuator": Actuator(-6.0, 6.0)}
    law = PredictiveControl(pendulum(), 0.6, STEP, **settings)
    with pytest.raises(ValueError, match=r"no feasible plan: q\[0\] of run 0 starts at 0.8"):
        run(law, SetPoint([0.2]), q0=0.8)
    run(law, SetPoint([0.2]), duration=2 * STEP)
    assert not caplog.text
    run(law, SetPoint([0.2]), q0=0.3, v0=6.0, duration=2 * STEP)
    assert "leaves the limits of q[0]" in caplog.text
    caplog.clear()
    law = PredictiveControl(pendulum(), 0.6, STEP, q_low=-0.5, actuator=Actuator(-6.0, 6.0))
    run(law, SetPoint([-0.2]), q0=-0.3, v0=-6.0, duration=2 * STEP)
    assert "leaves the limits of q[0]" in caplog.text


@pytest.mark.parametrize(("bad", "k"), [(np.nan, 0), (-np.inf, 1)])
def test_a_state_that_is_not_finite_holds_the_last_input(bad, k):
    law = PredictiveControl(pendulum(), 0.6, STEP, observer_bandwidth=5.0)
    pipeline, goal = Pipeline(law, STEP), SetPoint([1.0])(0.0)
    states = [double([[0.1]]), double([[0.0]])]
    broken = [x + bad if i == k else x for i, x in enumerate(states)]
    zero = torch.zeros(1, pipeline.memory_size).double()
    first = pipeline.call(*states, goal, zero)
    second = pipeline.call(*broken, goal, first.memory)
    assert torch.equal(second.u, first.u)
    assert second.report["solver_failed"].tolist() == [1.0]
    third = pipeline.call(*states, goal, second.memory)
    assert third.report["solver_failed"].tolist() == [0.0]
    assert third.u.isfinite().all()
    assert not pipeline.call(*broken, goal, zero).u.any()  # nothing was applied before


def test_limits_and_references_that_are_not_numbers_are_named():
    law = PredictiveControl(pendulum(), 0.6, STEP)
    state, goal = [double([[0.1]]), double([[0.0]])], SetPoint([1.0])(0.0)
    with pytest.raises(ValueError, match=r"the reference of v\[0\] 0 s ahead is not finite"):
        input_of(law, *state, goal._replace(v=double([np.nan])))
    for name in ("q_low", "v_max", "position_weight"):
        with pytest.raises(ValueError, match=rf"{name} is nan, expected 1 or 1 numbers"):
            PredictiveControl(pendulum(), 0.6, STEP, **{name: np.nan})
    with pytest.raises(ValueError, match="low nan and high None, expected low <= high"):
        Actuator(low=np.nan)
