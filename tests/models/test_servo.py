"""Position servos: passive mechanical systems whose inputs are targets."""

from functools import partial

import mujoco
import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from pinn_dyn.data.windows import draw_windows
from pinn_dyn.identification.constants import constants_table
from pinn_dyn.mechanics import Rosenbrock, Signal, Trajectory
from pinn_dyn.models import (
    ConstantCholesky,
    CoulombFriction,
    KnownMechanics,
    Servo,
)
from pinn_dyn.systems import RigidChain
from pinn_dyn.testing import MechanicalSystemContract, assert_near
from pinn_dyn.training import LeastSquares
from tests.models.builders import make_structured, random_batch
from tests.support.contracts import one_case
from tests.support.known import known_model, unit_scales


@pytest.mark.parametrize(
    ("kind", "limit"),
    [
        ("lnn", "learned"),
        ("hnn", None),
        ("feed-forward", 2.0),
        ("known", "learned"),
    ],
)
@one_case
class TestServo(MechanicalSystemContract):
    gradient_tolerance = 2e-5  # the force bends at its limit within a finite difference

    @pytest.fixture
    def system(self, kind, limit):
        servo = partial(Servo, limit=limit)
        if kind == "known":
            return known_model(friction=None, input=servo)
        if kind == "feed-forward":
            return make_structured("lnn", 3, 4, input=partial(servo, joints=[0, 2]))
        return make_structured(kind, input=servo, friction=CoulombFriction)


def test_a_known_limit_gives_the_scale_of_the_servos():
    """The weight of light links says nothing of it: k can start a hundred times too small."""
    scales = unit_scales(2)
    head = Servo(scales, limit=[3.0, 0.5])
    limits = torch.tensor([3.0, 0.5]).double()
    assert_near(head.spring_constant().double() * scales.statistics.q_std.double(), limits, 1e-5)
    assert_near(head.typical_force(torch.ones(2)).double(), limits / 10, 1e-5)


@pytest.mark.parametrize("limit", [None, 0.8])
def test_the_force_is_that_of_a_position_actuator_with_a_limit(limit):
    """MuJoCo's actuator ``position`` with a force range, away from the rounded corner."""
    robot = mujoco.MjModel.from_xml_string(f"""
        <mujoco><worldbody><body><joint name="j" type="slide"/><geom size="0.1" mass="1"/></body>
        </worldbody><actuator><position joint="j" kp="3" {
        f'forcerange="-{limit} {limit}"' if limit else ""
    }/></actuator></mujoco>""")
    data = mujoco.MjData(robot)
    head = Servo(unit_scales(1), stiffness=3.0, spread=0, limit=limit).double()
    for q, u in [(0.3, 0.4), (-0.2, 0.0), (0.1, 2.0), (1.0, -1.0)]:
        data.qpos[0], data.ctrl[0] = q, u
        mujoco.mj_forward(robot, data)
        v = torch.zeros(1).double()
        force = head.motor_force(torch.tensor([q]).double(), v, torch.tensor([u]).double())
        assert float(force) == pytest.approx(data.qfrc_actuator[0], rel=2e-2)


@pytest.mark.parametrize("kind", ["lnn", "known"])
def test_the_inverse_gives_the_target(kind):
    if kind == "known":
        model = known_model(friction=CoulombFriction, input=partial(Servo, stiffness=7.0))
    else:
        model = make_structured("lnn", input=Servo)
    n = model.num_coordinates
    q, v, _, u = random_batch(n, n)
    a = model.forward_dynamics(q, v, u)
    assert_near(model.input_for(q, v, a), u, 1e-9)


@pytest.mark.parametrize("kind", ["lnn", "known"])
def test_a_distant_target_pulls_with_the_limit(kind):
    servo = partial(Servo, stiffness=5.0, spread=0.0, limit=0.5)
    if kind == "known":
        model = known_model(friction=None, input=servo)
    else:
        model = make_structured("lnn", input=servo)
    n = model.num_coordinates
    q, v, _, _ = random_batch(n, n)
    far = [model.forward_dynamics(q, v, torch.full_like(q, u)) for u in (1e2, 1e6)]
    assert_near(far[0], far[1], 1e-6)
    servo = model.drives if kind == "known" else model.input
    pull = servo.motor_force(q, v, torch.full_like(q, 1e2))
    assert_near(pull, torch.full_like(q, 0.5), 1e-6)
    beyond = model.forward_dynamics(q, v, torch.full_like(q, 1e2)) + 1e3
    assert model.input_for(q, v, beyond).isnan().all(-1).all()  # no target gives that force


@pytest.mark.parametrize("kind", ["lnn", "hnn"])
def test_an_implicit_step_is_stable_with_a_stiff_servo(kind):
    """A stiffness of which RK4 at this step diverges; the rollout settles at the target."""
    servo = partial(Servo, spread=0.0)
    models = [
        make_structured(kind, 2, 2, input=servo, damping=ConstantCholesky, integrator=x)
        for x in (Rosenbrock(), None)
    ]
    for model in models:
        model.input.fixed_stiffness.fill_(1e6)
    t = torch.linspace(0, 1, 51).double()
    target = torch.tensor([0.3, -0.2]).double()
    x0 = torch.tensor([0.31, -0.2, 0.0, 0.0]).double()
    implicit, explicit = (model.predict(x0, t, Signal(t, target.expand(51, 2))) for model in models)
    assert float((implicit[-1, :2] - target).abs().max()) < 1e-3
    assert not float(explicit.nan_to_num(torch.inf).abs().max()) < 10


MASS, LENGTH, STIFFNESS, DAMPING, LIMIT = 0.05, 0.1, 0.8, 0.02, 0.12


def servo_log(seconds, seed, rate=50.0):
    """A pendulum on a hobby servo that saturates, by SciPy: held random targets."""
    generator = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate) + 1) / rate
    target = np.repeat(generator.uniform(-0.8, 0.8, len(t) // 15 + 1), 15)[: len(t)]
    inertia = MASS * LENGTH**2

    def motion(time, x):
        u = target[min(int(time * rate + 1e-9), len(t) - 1)]
        tau = np.clip(STIFFNESS * (u - x[0]) - DAMPING * x[1], -LIMIT, LIMIT)
        return [x[1], (tau - 0.003 * x[1] - MASS * 9.81 * LENGTH * np.sin(x[0])) / inertia]

    x = [np.zeros((1, 2))]
    for k in range(0, len(t) - 1, 15):  # a target is constant over 15 samples
        times = t[k : k + 16]
        span = times[0], times[-1] - 1e-9
        pieces = solve_ivp(motion, span, x[-1][-1], t_eval=[*times[1:-1], span[1]], rtol=1e-7)
        x.append(pieces.y.T)
    q, v = np.vstack(x).T[..., None]
    t = torch.from_numpy(t)
    signal = Signal(t, torch.from_numpy(target[:, None]), "hold")
    return Trajectory(torch.from_numpy(q), torch.from_numpy(v), signal)


HOBBY_SERVO = f"""<robot name="hobby"><link name="base"/><link name="arm"><inertial>
    <origin xyz="0 0 -{LENGTH}"/><mass value="{MASS}"/>
    <inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="horn" type="revolute"><parent link="base"/><child link="arm"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="9"/></joint></robot>"""


def fitted_servo(**settings):
    logs = [servo_log(5, seed) for seed in range(2)]
    windows = draw_windows(logs, count=100, steps=8, stride=1, seed=0)
    model = KnownMechanics(windows.statistics(), RigidChain(HOBBY_SERVO), **settings)
    fit = LeastSquares(cutoff=20).fit(model, logs, windows)
    return fit, constants_table(model, fit).set_index("name")


@pytest.mark.slow
def test_least_squares_identifies_gain_damping_and_limit_of_a_saturating_servo():
    servo = partial(Servo, limit="learned")
    fit, table = fitted_servo(start="prior", spread=0.05, input=servo)
    scale = table["value"]["mass of arm"] / MASS  # known to 5 %
    for name, truth in (("stiffness", STIFFNESS), ("damping", DAMPING), ("limit", LIMIT)):
        row = table.loc[f"servo {name} of horn"]
        assert row["value"] / scale == pytest.approx(truth, rel=0.05), name
        assert row["low"] < truth < row["high"], name
    assert table["unit"]["servo stiffness of horn"] == "Nm/rad"
    plain, _ = fitted_servo(start="prior", spread=0.05, input=Servo)
    assert fit.residual < 0.1 * plain.residual


def test_targets_come_first_and_then_feed_forward_forces_in_the_order_of_the_joints():
    """Joints 2 and 0 of three, with targets (0.5, -0.2) and forces (3, 7)."""
    model = make_structured(
        "lnn", 3, 4, input=partial(Servo, joints=[2, 0], stiffness=[10.0, 20.0])
    )
    q = torch.tensor([0.1, 0.4, 0.3]).double()
    u = torch.tensor([0.5, -0.2, 3.0, 7.0]).double()
    k = model.input.spring_constant().detach().double()
    expected = torch.stack([k[1] * (-0.2 - 0.1) + 7, 0 * k[0], k[0] * (0.5 - 0.3) + 3])
    at_rest = model.forward_dynamics(q, 0 * q, u) - model.forward_dynamics(q, 0 * q, 0 * u)
    force = model.mass_matrix(q) @ at_rest
    spring = torch.stack([-k[1] * 0.1, 0 * k[0], -k[0] * 0.3])
    assert_near(force + spring, expected, 1e-6)
    assert_near(model.input.motor_force(q, 0 * q, u), expected, 1e-6)
