"""Elastic joints: link and motor angles as the coordinates of known mechanics."""

from functools import partial

import numpy as np
import pinocchio
import pytest
import torch
from scipy.integrate import solve_ivp

from pinn_dyn.data.windows import draw_windows
from pinn_dyn.identification.constants import constants_table
from pinn_dyn.mechanics import RK4, Rosenbrock, Signal, Trajectory
from pinn_dyn.models import ElasticJoints, KnownMechanics, Servo
from pinn_dyn.systems import RigidChain
from pinn_dyn.testing import MechanicalSystemContract, assert_near
from pinn_dyn.training import LeastSquares
from tests.support.contracts import one_case, slow_except
from tests.support.known import elastic_model
from tests.support.rigid_chains import joint, link, robot


@pytest.mark.parametrize(
    "settings", slow_except([{}, {"input": partial(Servo, limit="learned")}], [{}])
)
@one_case
class TestElasticJoints(MechanicalSystemContract):
    gradient_tolerance = 2e-5  # the force of a servo bends at its limit

    @pytest.fixture
    def system(self, settings):
        return elastic_model(**settings)


def test_each_spring_is_between_a_link_and_its_motor():
    model = elastic_model(joints=("bend", "turn"))
    names = model.structure.joint_names
    pairs = [[names.index(joint), names.index(f"{joint}_motor")] for joint in ("bend", "turn")]
    for k, pair in enumerate(pairs):
        q = torch.zeros(len(names)).double()
        q[pair] = 0.1
        assert not model.elastic.forces(q, q).any()
        q[pair[0]] = 0
        force = 0.1 * (model.elastic.stiffness() + model.elastic.damping())
        assert_near(model.elastic.forces(q, q), force * torch.eye(2)[k], 1e-9)
    x = torch.randn(5, len(names), generator=torch.Generator().manual_seed(0)).double()
    for matrix, at in zip(model.elastic.matrices(), ((x, 0 * x), (0 * x, x)), strict=True):
        assert_near(x @ matrix, model.elastic.forces(*at) @ model.elastic.stretch, 1e-9)


ARM = robot(
    link("base"),
    link("upper", 2.0),
    link("lower", 1.0),
    joint("shoulder", "revolute", "base", "upper", rpy="0 0 0", axis="0 1 0"),
    joint("elbow", "revolute", "upper", "lower", rpy="0 0 0", axis="0 1 0"),
)
K, D, B, FRICTION = np.array([300.0, 150.0]), np.array([0.6, 0.3]), np.array([0.2, 0.1]), 0.4


def flexible_arm(seconds, seed, rate=500.0, noise=2e-5):
    """A motion by Pinocchio's forward dynamics and SciPy's implicit solver."""
    model = pinocchio.buildModelFromXML(ARM)
    data, rng = model.createData(), np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.2, 3.0, (2, 6)), rng.uniform(0, 6, (2, 6))

    def torque(t):
        return [12, 5] * np.sin(6.28 * frequency * t + phase).sum(1) / 2

    def motion(t, x):
        q, theta, v, w = x.reshape(4, 2)
        spring = K * (theta - q) + D * (w - v)
        a = pinocchio.aba(model, data, q, v, spring - 0.1 * v)
        return np.concatenate([v, w, a, (torque(t) - FRICTION * w - spring) / B])

    t = np.arange(round(seconds * rate)) / rate
    x = solve_ivp(motion, (0, t[-1]), np.zeros(8), "Radau", t, rtol=1e-7, atol=1e-9).y.T
    x += noise * rng.normal(size=x.shape) * ([1] * 4 + [50] * 4)
    q, v = torch.from_numpy(x).chunk(2, dim=-1)
    t = torch.from_numpy(t)
    u = torch.from_numpy(np.array([torque(time) for time in t.numpy()]))
    return Trajectory(q, v, Signal(t, u, "cubic"))


@pytest.mark.slow
def test_least_squares_identifies_springs_and_motors_of_a_flexible_arm(caplog):
    log = flexible_arm(8.0, 0)
    windows = draw_windows([log], count=60, steps=10, stride=1, seed=0)
    model = KnownMechanics(
        windows.statistics(), ElasticJoints(RigidChain(ARM)), start="prior", spread=0.3
    )
    with caplog.at_level("WARNING"):
        fit = LeastSquares(cutoff=30, rollouts=False).fit(model, [log])
    assert not caplog.records
    table = constants_table(model, fit).set_index("name")
    names = [*model.elastic.stiffness.names, *model.armature.names]
    for name, truth in zip(names, [*K, *B], strict=True):
        row = table.loc[name]
        assert row["value"] == pytest.approx(truth, rel=0.05), name
        assert row["low"] < truth < row["high"], name
    assert table["unit"]["joint stiffness of elbow"] == "Nm/rad"
    test = flexible_arm(2.0, 1, noise=0.0)
    x0 = torch.cat([test.q[0], test.v[0]]).float()
    signal = Signal(test.t.float(), test.input.u.float(), "cubic")
    for model.integrator in (RK4(), Rosenbrock()):
        q = model.predict(x0, test.t.float(), signal).detach()[:, :4]
        error = (q - test.q).norm(dim=-1).mean()
        assert float(error) < 0.1 * float(test.q.std(0).norm())
