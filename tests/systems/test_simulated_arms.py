"""Simulated arms: terms against closed forms, steps of both simulators against the terms."""

import copy
import pickle
import pkgutil
import re
import sys

import numpy as np
import pytest
import torch

from pinn_dyn.systems import BulletArm, MujocoArm, RigidChain
from pinn_dyn.testing.mechanical_system import Configurations, MechanicalSystemContract
from tests.support.contracts import one_case
from tests.support.rigid_chains import TREE
from tests.support.simulated_arms import FINGERS, PANDA, SIMULATORS, SPATIAL, simulated_by, states

ARMS = [
    (PANDA, {"locked_joints": FINGERS, "payload": 1.5, "mass_scale": 1.2}),
    pytest.param("kuka_iiwa/model.urdf", {"gravity": (1.0, -2.0, -9.81)}, marks=pytest.mark.panda),
    (SPATIAL, {"damping": [0.3, 0.0]}),
    (SPATIAL.replace('izz="0.1"', 'izz="0.3"'), {}),  # moments that no body has
    (TREE, {"locked_joints": ["wrist"], "damping": 0.02}),  # a fork and a sliding joint
]


mujoco = pytest.importorskip("mujoco", reason="the mujoco extra is not installed")


@pytest.fixture(params=SIMULATORS)
def Arm(request):
    return simulated_by(request.param)


@one_case
class TestPanda(MechanicalSystemContract):
    @pytest.fixture
    def system(self, panda):
        return panda

    @pytest.fixture
    def configurations(self, panda):
        q, v, a = states(panda, 8)
        return Configurations(*(torch.from_numpy(x) for x in (q, v, a, 10 * a)))


# Against independent answers.


def panda_text():
    return RigidChain(PANDA).tree.path.read_text()


@pytest.mark.panda
def test_the_panda_is_that_of_pybullet():
    """Also its limits, and the text that a simulator loads, so that recordings stay the same."""
    data = pytest.importorskip("pybullet_data", reason="the panda extra is not installed")
    arms = [
        MujocoArm(urdf, locked_joints=FINGERS) for urdf in (PANDA, f"{data.getDataPath()}/{PANDA}")
    ]
    assert arms[0].tree.path != arms[1].tree.path
    assert arms[0].describe() == arms[1].describe()
    assert arms[0].tip_position(torch.ones(7)).equal(arms[1].tip_position(torch.ones(7)))


@pytest.mark.parametrize(
    ("urdf", "tip"), [(PANDA, "panda_grasptarget"), (SPATIAL, "two"), (TREE, "hand")]
)
def test_the_terms_are_those_of_mujoco(urdf, tip):
    """MuJoCo reads the file itself, with all joints; those that are locked stay at zero."""
    locked = [*FINGERS] if urdf == PANDA else ["wrist"] if urdf == TREE else []
    chain = RigidChain(urdf, locked_joints=locked)
    spec = mujoco.MjSpec.from_string(panda_text() if urdf == PANDA else urdf)
    spec.compiler.fusestatic = False  # which drops the moments of links without mass
    model = spec.compile()
    model.opt.disableflags = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    rows = [model.joint(name).dofadr[0] for name in chain.joint_names]
    for q, v, a in np.random.default_rng(0).uniform(-2, 2, (20, 3, len(rows))):
        data.qpos[rows], data.qvel[rows], data.qacc[rows] = q, v, a
        mujoco.mj_inverse(model, data)
        mujoco.mj_fullM(model, data, mass)
        state = [torch.from_numpy(x) for x in (q, v, a)]
        M, bias = chain.mass_and_bias(*state[:2])
        pairs = [(M, mass[np.ix_(rows, rows)]), (bias, data.qfrc_bias[rows])]
        pairs.append((chain.inverse_dynamics(*state), data.qfrc_inverse[rows]))
        pairs.append((chain.tip_position(state[0]), data.body(tip).xpos))
        for ours, theirs in pairs:
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * np.abs(theirs).max())


# Motion.


@pytest.mark.parametrize(("urdf", "settings"), ARMS)
def test_a_step_is_that_of_the_equation_of_motion(Arm, urdf, settings):
    """Also far beyond the joint and speed limits of the URDF, where nothing may stop the arm."""
    arm = Arm(urdf, **{"damping": 0.0, **settings})
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


def test_arms_stepped_in_turn_move_as_if_alone(Arm):
    """Nothing is kept of an earlier arm, nor of an arm whose damping alone differs."""
    panda = Arm(PANDA, locked_joints=FINGERS)
    arms = [panda, panda, Arm(PANDA, locked_joints=FINGERS, damping=2.0)]
    heavy = Arm(PANDA, locked_joints=FINGERS, gravity=(0, 0, -19.62))
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


def test_a_pendulum_keeps_its_energy_between_the_walls_and_frictions_of_its_urdf(Arm, pendulum):
    """Released at 1.2 rad between walls at 0.1 rad and with friction in the URDF."""
    arm = Arm(pendulum(), damping=0)
    arm.set_state(np.array([1.2, 0.4]), np.zeros(2))
    moved = [arm.step(np.zeros(2), 1e-4) for _ in range(20000)]
    q, v = (torch.from_numpy(np.array(x[::100])) for x in zip(*moved, strict=True))
    assert q[:, 0].min() < -0.5
    energy = arm.total_energy(q, v)
    # Semi-implicit Euler: the error is of first order in the step and does not accumulate.
    assert (energy - energy[0]).abs().max() < 2e-3 * (energy.max() - energy.min() + 10)


MJCF = """<mujoco><worldbody>
  <body><joint name="turn" axis="0 1 0" range="-1 1" limited="true" damping="3" armature="2"/>
    <geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 0"/>
    <body pos="0.3 0 0"><joint name="slide" type="slide" axis="1 0 0" range="0 0.1"/>
      <geom type="box" size="0.05 0.04 0.03"/></body></body></worldbody></mujoco>"""


def test_an_mjcf_is_simulated_within_limits_of_the_user(Arm):
    """The file has no limits of speed and torque; its friction and armature are no part."""
    arm = Arm(MJCF, damping=[0.1, 0.2], v_max=3.0, u_max=[20.0, 50.0])
    assert arm.v_max.tolist() == [3, 3]
    assert arm.u_max.tolist() == [20, 50]
    assert Arm(MJCF, damping=[0.1, 0.2], v_max=3.0, u_max=20.0).describe() != arm.describe()
    q, v, u = np.array([0.5, 0.02]), np.array([1.0, -2.0]), np.array([3.0, 5.0])
    a = arm.forward_dynamics(*map(torch.from_numpy, (q, v, u))).numpy()
    arm.set_state(q, v)
    np.testing.assert_allclose(arm.step(u, 1e-3)[1], v + 1e-3 * a, rtol=0, atol=1e-10)


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
        MujocoArm(pendulum(*changes))


def test_mimic_joints_are_refused_with_a_setting_that_works():
    text = TREE.replace('continuous">', 'continuous"><mimic joint="turn"/>')
    with pytest.raises(ValueError, match="mimic joints: add") as error:
        MujocoArm(text, locked_joints=["wrist"])
    (name,) = re.findall(r"add \['(\w+)'\]", str(error.value))
    assert MujocoArm(text, locked_joints=["wrist", name]).joint_names == ["turn", "slide", "fork"]


def test_an_arm_without_its_simulator_names_one_that_is_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ImportError, match=r"BulletArm needs pybullet: .*, or use ") as error:
        BulletArm(TREE, locked_joints=["wrist"])
    other = pkgutil.resolve_name(str(error.value).rpartition(" ")[2])
    assert other(TREE, locked_joints=["wrist"]).num_coordinates == 4
