"""PyBullet arms: terms against closed forms and PyBullet, steps against the equation of motion."""

import copy
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import torch

pybullet = pytest.importorskip("pybullet", reason="PyBullet is not installed (the panda extra)")
import pybullet_data  # noqa: E402

from pinn_dyn.systems import BulletArm  # noqa: E402
from pinn_dyn.testing.mechanical_system import Configurations, MechanicalSystemContract  # noqa: E402
from tests.support.bullet_arms import FINGERS, PANDA, states  # noqa: E402
from tests.support.rigid_chains import TREE  # noqa: E402
from tests.support.urdf_by_hand import (  # noqa: E402
    SPATIAL,
    jacobian_of,
    urdf_frames,
    urdf_mass_matrix,
)

pytestmark = pytest.mark.panda

ARMS = [
    (PANDA, {"locked_joints": FINGERS, "payload": 1.5, "mass_scale": 1.2}),
    ("kuka_iiwa/model.urdf", {"gravity": (1.0, -2.0, -9.81)}),
    (SPATIAL, {"damping": [0.3, 0.0]}),
    (TREE, {"locked_joints": ["wrist"]}),  # a fork and a sliding joint
]


class TestPanda(MechanicalSystemContract):
    @pytest.fixture
    def system(self, panda):
        return panda

    @pytest.fixture
    def configurations(self, panda):
        q, v, a = states(panda, 8)
        return Configurations(*(torch.from_numpy(x) for x in (q, v, a, 10 * a)))


# Against independent answers.


def pendulum_terms(q, v, g=9.81):
    """M, C v and G of the double pendulum, from its Lagrangian by hand."""
    m1, m2, c1, c2, l1, i1, i2 = 1.5, 0.8, 0.3, 0.2, 0.5, 0.05, 0.02
    k = m2 * l1 * c2
    m22 = m2 * c2**2 + i2
    m12 = m22 + k * np.cos(q[1])
    m11 = m1 * c1**2 + i1 + m2 * l1**2 + m22 + 2 * k * np.cos(q[1])
    coriolis = k * np.sin(q[1]) * np.array([-(2 * v[0] + v[1]) * v[1], v[0] ** 2])
    g2 = m2 * g * c2 * np.sin(q[0] + q[1])
    gravity = np.array([(m1 * c1 + m2 * l1) * g * np.sin(q[0]) + g2, g2])
    return np.array([[m11, m12], [m12, m22]]), coriolis, gravity


@pytest.mark.parametrize("gravity", [9.81, 0.0])
def test_double_pendulum_has_the_terms_of_its_closed_form(pendulum, gravity):
    arm = BulletArm(pendulum(), gravity=(0, 0, -gravity), damping=(0.3, 0.2))
    assert arm.joint_names == ["shoulder", "elbow"]
    q, v, a = states(arm)
    for k in range(len(q)):
        M, Cv, G = pendulum_terms(q[k], v[k], gravity)
        at = [torch.from_numpy(x[k]) for x in (q, v, a)]
        np.testing.assert_allclose(arm.mass_matrix(at[0]), M, rtol=0, atol=1e-12)
        np.testing.assert_allclose(arm.potential_force(at[0]), G, rtol=0, atol=1e-11)
        expected = M @ a[k] + Cv + G + np.array([0.3, 0.2]) * v[k]
        np.testing.assert_allclose(arm.inverse_dynamics(*at), expected, rtol=0, atol=1e-11)
        force = arm.coriolis_matrix(*at[:2]) @ at[1]
        np.testing.assert_allclose(force, Cv, rtol=0, atol=1e-11)


def panda_text():
    return Path(pybullet_data.getDataPath(), PANDA).read_text()


@pytest.mark.parametrize("urdf", [PANDA, SPATIAL])
def test_the_mass_matrix_is_that_of_the_urdf(urdf):
    """Skew axes, turned inertial frames and products of inertia count in full."""
    arm = BulletArm(urdf, locked_joints=FINGERS if urdf == PANDA else ())
    text = panda_text() if urdf == PANDA else urdf
    for q in states(arm)[0]:
        M = arm.mass_matrix(torch.from_numpy(q))
        np.testing.assert_allclose(M, urdf_mass_matrix(text, q), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("urdf", "tip", "link"),
    [
        (PANDA, None, "panda_grasptarget"),
        (PANDA, "panda_link5", "panda_link5"),
        (SPATIAL, "one", "one"),
        (SPATIAL, None, "two"),
    ],
)
def test_the_tip_is_where_the_urdf_puts_it_and_carries_the_payload(urdf, tip, link):
    settings = {"locked_joints": FINGERS if urdf == PANDA else (), "tip": tip}
    arm = BulletArm(urdf, gravity=(1, -2, -9.81), **settings)
    loaded = BulletArm(urdf, gravity=(1, -2, -9.81), payload=2.3, **settings)
    g = np.array(arm.gravity)
    for q in states(arm)[0]:
        x = torch.from_numpy(q)
        _, r, axes = urdf_frames(panda_text() if urdf == PANDA else urdf, q)[link]
        np.testing.assert_allclose(arm.tip_position(x), r, rtol=0, atol=1e-12)
        J, _ = jacobian_of(r, axes, len(q))
        slope = torch.autograd.functional.jacobian(arm.tip_position, x)
        np.testing.assert_allclose(slope, J, rtol=0, atol=1e-12)
        added = loaded.mass_matrix(x) - arm.mass_matrix(x)
        np.testing.assert_allclose(added, 2.3 * J.T @ J, rtol=0, atol=1e-13)
        added = loaded.potential_force(x) - arm.potential_force(x)
        np.testing.assert_allclose(added, -2.3 * J.T @ g, rtol=0, atol=1e-12)


# Motion.


@pytest.mark.parametrize("damping", [0.0, 0.02])
@pytest.mark.parametrize(("urdf", "settings"), ARMS)
def test_a_step_is_that_of_the_equation_of_motion(urdf, settings, damping):
    """Also far beyond the joint and speed limits of the URDF, where nothing may stop the arm."""
    arm = BulletArm(urdf, **{**settings, "damping": damping})
    rng = np.random.default_rng(1)
    q, v = arm.q_high + 0.5, np.minimum(2 * arm.v_max, 4.0)
    arm.set_state(q, v)
    for _ in range(60):
        u = rng.uniform(-0.1, 0.1, len(q))
        a = arm.forward_dynamics(*(torch.from_numpy(x) for x in (q, v, u))).numpy()
        q_next, v_next = arm.step(u, 1e-3)
        np.testing.assert_allclose(v_next, v + 1e-3 * a, rtol=0, atol=1e-12 * np.abs(a).max())
        np.testing.assert_allclose(q_next, q + 1e-3 * v_next, rtol=0, atol=1e-12)
        q, v = q_next, v_next


def test_arms_stepped_in_turn_move_as_if_alone(panda):
    """PyBullet keeps nothing of an earlier arm, nor of an arm whose damping alone differs."""
    arms = [panda, panda, BulletArm(PANDA, locked_joints=FINGERS, damping=2.0)]
    heavy = BulletArm(PANDA, locked_joints=FINGERS, gravity=(0, 0, -19.62))
    q0, v0, _ = states(panda, 3)
    torques = np.random.default_rng(3).uniform(-10, 10, (3, 40, 7))
    alone = []
    for i, arm in enumerate(arms):
        arm.set_state(q0[i], v0[i])
        alone.append([arm.step(u, 1e-3) for u in torques[i]])
    q, v = q0.copy(), v0.copy()
    for k in range(40):
        for i, arm in enumerate(arms):
            arm.set_state(q[i], v[i])
            heavy.set_state(0 * q[i], v[i])
            q[i], v[i] = arm.step(torques[i, k], 1e-3)
            np.testing.assert_array_equal((q[i], v[i]), alone[i][k])


def test_a_pendulum_keeps_its_energy_between_the_walls_and_frictions_of_its_urdf(pendulum):
    """Released at 1.2 rad between walls at 0.1 rad and with friction in the URDF."""
    arm = BulletArm(pendulum(), damping=0)
    arm.set_state(np.array([1.2, 0.4]), np.zeros(2))
    moved = [arm.step(np.zeros(2), 1e-4) for _ in range(20000)]
    q, v = (torch.from_numpy(np.array(x[::100])) for x in zip(*moved, strict=True))
    assert q[:, 0].min() < -0.5
    energy = arm.total_energy(q, v)
    # Semi-implicit Euler: the error is of first order in the step and does not accumulate.
    assert (energy - energy[0]).abs().max() < 2e-3 * (energy.max() - energy.min() + 10)


# As an object among others.


def test_copies_and_pickles_give_the_same_numbers(panda):
    q = torch.from_numpy(states(panda)[0])
    for twin in (copy.deepcopy(panda), pickle.loads(pickle.dumps(panda))):
        assert torch.equal(twin.mass_matrix(q), panda.mass_matrix(q))
        assert torch.equal(twin.damping_matrix(q), panda.damping_matrix(q))
        assert twin.describe() == panda.describe()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([('value="0.8"', 'value="0"')], "link .lower. moves with a mass of 0.0 kg"),
        ([('lower="-0.1"', 'lower="0.1"')], "joint .shoulder. has the limits 0.1 to"),
    ],
)
def test_a_robot_that_is_no_arm_is_refused_with_what_to_do(pendulum, changes, message):
    with pytest.raises(ValueError, match=message):
        BulletArm(pendulum(*changes))


def test_mimic_joints_are_refused_with_a_setting_that_works():
    text = TREE.replace('continuous">', 'continuous"><mimic joint="turn"/>')
    with pytest.raises(ValueError, match="mimic joints: add") as error:
        BulletArm(text, locked_joints=["wrist"])
    (name,) = re.findall(r"add \['(\w+)'\]", str(error.value))
    assert BulletArm(text, locked_joints=["wrist", name]).joint_names == ["turn", "slide", "fork"]
