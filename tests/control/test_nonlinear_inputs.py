"""Laws on forces that are not linear in the input: tendons, learned A(q, u) u, limited servos."""

from functools import partial

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from pinn_dyn.control import (
    ComputedTorque,
    DisturbanceObserver,
    Motion,
    Pipeline,
    ProportionalDerivative,
    Regulation,
    SetPoint,
    SystemPlant,
    Tracking,
    close_loop,
)
from pinn_dyn.mechanics import InputSolver
from pinn_dyn.mechanics.arrays import pseudo_inverse_times
from pinn_dyn.models import Servo
from pinn_dyn.systems import SoftArm, TendonArm
from pinn_dyn.testing import assert_near
from pinn_dyn.testing.finite_differences import partial_derivatives
from tests.models.builders import make_structured

ARMS = {"square": TendonArm, "four-tendons": partial(TendonArm, tendons=4)}


def draw(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(*shape, generator=generator, dtype=torch.float64) - 1


def arm_states(count=6, seed=0):
    """q, v and a motion that taut tendons can follow."""
    scale = torch.tensor([0.2, 0.2, 0.004], dtype=torch.float64)
    offset = torch.tensor([0.0, 0.0, -0.024], dtype=torch.float64)
    q, v, q_ref, v_ref, a_ref = draw(5, count, 3, seed=seed) * scale
    return q + offset, 0.1 * v, Motion(q_ref + offset, 0.1 * v_ref, a_ref)


def call_of(law, q, v, motion, previous=None):
    """The result of a call, after one with the input ``previous``."""
    first = 0.0 if previous is None else previous
    pipeline = Pipeline(law)
    memory = torch.zeros(len(q), pipeline.memory_size).double()
    if previous is not None:
        memory = torch.cat([torch.ones(len(q), 1), first], dim=-1)
    return pipeline.call(q, v, motion, memory)


@pytest.fixture(params=ARMS)
def arm(request):
    return ARMS[request.param]()


# The solver.


@pytest.mark.parametrize(("n", "m"), [(3, 3), (2, 4), (4, 2)])
def test_a_linear_force_is_inverted_as_by_the_pseudo_inverse(n, m):
    A, tau = draw(5, n, m) + 2 * torch.eye(n, m).double(), draw(5, n, seed=1)
    expected = pseudo_inverse_times(A, tau)
    solve = partial(InputSolver(), lambda u: (A @ u[..., None])[..., 0], tau)
    for start in (torch.zeros(5, m).double(), 10 * draw(5, m, seed=2)):
        solution = solve(torch.zeros(5, m).double(), start)
        assert solution.converged.all()
        assert_near(solution.u, expected, 1e-6)


def test_of_more_tendons_than_coordinates_the_input_of_least_norm_is_found():
    arm = ARMS["four-tendons"]()
    q, v, motion = arm_states()
    tau = arm.inverse_dynamics(q, v, motion.a)
    u = arm.input_for(q, v, motion.a)
    assert_near(arm.input_force(q, u), tau, 1e-7)
    for _ in range(3):  # instants of a loop
        u = arm.solve_input(InputSolver(), q, v, tau, u).u
    for k in range(3):

        def force(x, k=k):
            return arm.input_force(q[k], torch.from_numpy(x)).numpy()

        expected = minimize(
            lambda x: x @ x,
            u[k].numpy() + 0.1,
            constraints={"type": "eq", "fun": lambda x, k=k: force(x) - tau[k].numpy()},
            options={"ftol": 1e-14, "maxiter": 200},
        )
        assert np.linalg.norm(force(expected.x) - tau[k].numpy()) < 1e-6
        assert float(u[k].norm()) < 1.02 * np.linalg.norm(expected.x)


def test_limits_of_the_input_are_kept_where_another_input_gives_the_force():
    arm = ARMS["four-tendons"]()
    q, v, motion = arm_states()
    tau = arm.inverse_dynamics(q, v, motion.a)
    free = arm.input_for(q, v, motion.a)
    low, high = float(free.min()) + 0.05, float(free.max()) - 0.05
    solution = arm.solve_input(InputSolver(low=low, high=high), q, v, tau)
    inside = solution.converged
    assert inside.any()
    assert not torch.equal(solution.u[inside], free[inside])
    assert solution.u.min() >= low
    assert solution.u.max() <= high
    assert_near(arm.input_force(q, solution.u)[inside], tau[inside], 1e-7)


def test_every_posture_that_taut_tendons_hold_has_an_input():
    """Tensions by a linear solve, and angles by the inverse of T(s), for tendons slack at u = 0."""
    arm = TendonArm()
    q = draw(100, 3) * torch.tensor([0.2, 0.2, 0.004]) + torch.tensor([0.0, 0.0, -0.024])
    B, w, k = arm.routing, arm.slack, arm.tendon_stiffness
    backbone = SoftArm(1, stiffness=[0.5, 0.5, 600.0], damping=0.1, mass=0.3, length=0.2)
    tension = torch.linalg.solve(B.mT, -backbone.potential_force(q)[..., None])[..., 0]
    assert tension.min() > 1.0
    stretch = tension / k - k * w**2 / (4 * tension)
    expected = (stretch - q @ B.mT - arm.pretension / k) / arm.spool
    assert_near(arm.input_for(q, 0 * q, 0 * q), expected, 1e-6)


def test_a_servo_that_saturates_gets_the_target_of_the_acceleration():
    model = make_structured("lnn", input=partial(Servo, limit=[2.0, 2.0, 2.0]))
    q, v = draw(2, 20, 3)
    target = 0.2 * draw(20, 3, seed=3)
    a = model.forward_dynamics(q, v, q + target).detach()
    u = model.input_for(q, v, a).detach()
    assert torch.isfinite(u).all(-1).double().mean() > 0.9
    reached = torch.isfinite(u).all(-1)
    assert_near(model.forward_dynamics(q, v, u)[reached], a[reached], 1e-6)


# The laws.


def test_the_laws_hold_follow_and_correct_as_with_a_matrix(arm):
    q, v, motion = arm_states()
    zero = torch.zeros_like(q)
    hold = Regulation(arm, 5.0, 1.0)
    result = call_of(hold, q, zero, Motion(q, zero, zero))
    a = arm.forward_dynamics(q, zero, result.u)
    slack = arm.forward_dynamics(q, zero, 0 * arm.typical_input(q))
    assert_near(a, zero, 1e-6, scale=slack.abs().max())
    assert not result.status.any()
    exact = InputSolver(tolerance=1e-10)
    law = Tracking(arm, 5.0, 1.0, solver=exact)
    follow = call_of(law, motion.q, motion.v, motion).u
    assert_near(arm.forward_dynamics(motion.q, motion.v, follow), motion.a, 1e-4)
    kp, kd = torch.tensor([[30.0, 40.0, 50.0], [8.0, 9.0, 10.0]]).double()
    u = call_of(ComputedTorque(arm, kp, kd, solver=exact), q, v, motion).u
    expected = motion.a + kd * (motion.v - v) + kp * (motion.q - q)
    assert_near(arm.forward_dynamics(q, v, u), expected, 1e-4)


def test_the_feedback_passes_the_jacobian_at_the_solution(arm):
    q, v, motion = arm_states()
    feedback = 3.0 * (motion.q - q) + 0.5 * (motion.v - v)
    held = arm.input_for(q, 0 * v, 0 * v)
    for law, start in ((Regulation, held), (ProportionalDerivative, arm.typical_input(q))):
        slopes = partial_derivatives(lambda u: arm.input_force(q, u), start, 1e-5)
        u = call_of(law(arm, 3.0, 0.5), q, v, motion).u
        assert_near(u - start, (slopes.mT @ feedback[..., None])[..., 0], 1e-5)


def test_a_force_that_no_input_gives_is_a_fault_of_its_row_that_holds_the_input():
    arm = TendonArm()
    q, v, motion = arm_states()
    law = Tracking(arm, 5.0, 0.1)
    before = call_of(law, q, v, motion)
    assert not before.status.any()
    assert float(before.report["input_residual"].max()) < 1e-6
    a = motion.a.clone()
    a[2, 2] = 1e3  # tendons cannot push
    result = call_of(law, q, v, motion._replace(a=a), before.u)
    assert (result.status.long() & 16).tolist() == [0, 0, 16, 0, 0, 0]
    assert torch.equal(result.u[2], before.u[2])
    assert float(result.report["input_residual"][2]) > 1.0


@pytest.mark.slow
def test_the_regulator_holds_the_tendon_arm_under_friction_and_dead_time():
    arm = TendonArm()
    q_ref = torch.tensor([[0.15, -0.1, -0.024], [-0.2, 0.1, -0.022]]).double()
    q0 = torch.tensor([0.0, 0.0, -0.0085]).double().expand(2, 3)
    law = Regulation(arm, [3.0, 3.0, 0.3], [0.1, 0.1, 0.003])
    record = close_loop(
        SystemPlant(arm), law, SetPoint(q_ref), q0, 0 * q0, duration=1.2, rate=250, dead_time=0.008
    )
    assert record.stopped == [None, None]
    error = (record.q[:, -1] - q_ref).norm(dim=-1) / (q0 - q_ref).norm(dim=-1)
    assert float(error.max()) < 0.01


def test_the_observer_refuses_it_by_name():
    with pytest.raises(ValueError, match=r"observer needs a force A\(q\) u"):
        DisturbanceObserver(Regulation(TendonArm(), 1.0, 1.0), 10.0)
