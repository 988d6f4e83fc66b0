"""Designed motions against random ones, on an arm that MuJoCo moves."""

import itertools

import numpy as np
import pytest
import torch
import yaml

import pinn_dyn
from pinn_dyn.identification.motion_limits import Envelope, MotionLimits
from pinn_dyn.identification.rigid_excitation import motion_excitation
from pinn_dyn.systems import RigidChain
from tests.support.rigid_chains import joint, link, robot

ARM = robot(
    link("base"),
    link("turret", 2.0),
    link("upper", 0.8, centre="0.01 0.02 0.12"),
    link("fore", 0.5, centre="0.02 -0.01 0.1"),
    joint("turn", "revolute", "base", "turret", rpy="0 0 0", axis="0 0 1"),
    joint("lift", "revolute", "turret", "upper", xyz="0 0 0.1", rpy="0 0 0"),
    joint("bend", "revolute", "upper", "fore", rpy="0 0 0"),
)
DURATION, VELOCITY, TORQUE = 5.0, 2.7, 9.0  # 90 % of the limits of the URDF


@pytest.fixture(scope="module")
def design():
    return pinn_dyn.design_excitation(ARM, duration=DURATION, steps=60)


@pytest.fixture(scope="module")
def random_motions():
    """Fourier motions of the same duration and harmonics, as fast as the limits allow."""
    rng, t = np.random.default_rng(1), np.arange(0, DURATION, 0.005)
    w = 2 * np.pi / DURATION * np.arange(1, 5)[:, None]
    motions = []
    for _ in range(100):
        phase = rng.uniform(0, 2 * np.pi, (3, 4, 1))
        sizes = rng.normal(size=(3, 4, 1)) / w
        q, v, a = (
            (sizes * w**k * np.sin(w * t + phase + k * np.pi / 2)).sum(1).T for k in range(3)
        )
        ends = ((1.8, q), (VELOCITY, v), (3 * VELOCITY, a))
        scale = np.min([high / np.abs(x).max(0) for high, x in ends], axis=0)
        motions.append([torch.from_numpy(x * scale) for x in (q, v, a)])
    return motions


def test_the_condition_number_is_a_third_of_that_of_random_motions(design, random_motions):
    chain = RigidChain(ARM)
    conditions = [motion_excitation(chain, *motion).condition for motion in random_motions]
    again = motion_excitation(chain, design.q[::5], design.v[::5], design.a[::5])
    assert again.condition < np.median(conditions) / 3
    assert design.excitation.condition == pytest.approx(again.condition, rel=0.05)
    assert again.condition < design.random_condition / 3


def test_limits_hold_at_1_khz_and_the_motion_starts_and_ends_at_rest(design):
    q, v, a, tau = (x.numpy() for x in (design.q, design.v, design.a, design.tau))
    t = design.t.numpy()
    assert t[1] == 0.001
    assert t[-1] == DURATION
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], v[1:-1], atol=1e-4)
    np.testing.assert_allclose(np.gradient(v, t, axis=0)[1:-1], a[1:-1], atol=1e-3)
    assert (np.abs(q) <= 1.8).all()
    assert (np.abs(v) <= VELOCITY).all()
    assert (np.abs(a) <= 3 * VELOCITY).all()
    assert (np.abs(tau) <= TORQUE).all()
    np.testing.assert_allclose([q[0], q[-1], v[0], v[-1], a[0], a[-1]], 0, atol=1e-9)
    # The velocities or the positions are used up, as far as the search comes.
    assert (np.maximum(np.abs(q).max(0) / 1.8, np.abs(v).max(0) / VELOCITY) > 0.85).all()


def test_the_message_is_a_joint_trajectory_of_ros(design):
    typestore = pytest.importorskip("rosbags.typesys")
    store = typestore.get_typestore(typestore.Stores.ROS2_HUMBLE)
    fields = {name for name, _ in store.get_msgdef("trajectory_msgs/msg/JointTrajectory").fields}
    point = {
        name for name, _ in store.get_msgdef("trajectory_msgs/msg/JointTrajectoryPoint").fields
    }
    message = yaml.safe_load(design.joint_trajectory(approach=2.5))
    assert message.keys() <= fields
    assert all(x.keys() <= point for x in message["points"])
    assert message["points"][-1]["time_from_start"] == {"sec": 7, "nanosec": 500000000}
    times = [x["time_from_start"] for x in message["points"]]
    seconds = [x["sec"] + 1e-9 * x["nanosec"] for x in times]
    assert all(low < high for low, high in itertools.pairwise(seconds))
    assert len(design.joint_trajectory()) < 2**17  # longest argument of a program on Linux


def test_other_limits_by_joint_and_the_height_of_the_tip_hold():
    limits = {
        "low": {"lift": 0.3},
        "velocity": [1.0, 2.0, 3.0],
        "torque": {"lift": 4.0},
        "lowest_tip": 0.35,
        "share": 1.0,
    }
    start = {"lift": 0.8, "bend": -0.5}
    motion = pinn_dyn.design_excitation(ARM, limits, DURATION, start=start, steps=20, seed=1)
    low, high = (motion.q.numpy().min(0), motion.q.numpy().max(0))
    assert low[1] >= 0.3
    assert (low[[0, 2]] >= -2).all()
    assert (high <= 2).all()
    assert (motion.v.abs().amax(0) <= torch.tensor([1.0, 2.0, 3.0]).double()).all()
    assert motion.tau[:, 1].abs().max() <= 4.0
    height = RigidChain(ARM).tip_position(motion.q)[:, 2]
    assert height.min() >= 0.35
    np.testing.assert_allclose(motion.q[0], [0, 0.8, -0.5], atol=1e-12)
    assert motion.excitation.condition < motion.random_condition


def test_a_motion_to_either_limit_uses_it_up_from_any_start():
    envelope = Envelope(RigidChain(ARM), MotionLimits(), {"lift": 0.8})
    for end in (envelope.low, envelope.high):
        q = (end - envelope.start)[None]
        torch.testing.assert_close(envelope.scale(q, 0 * q, 0 * q), torch.ones(3).double())


def test_limits_that_the_urdf_lacks_are_named_and_joints_have_friction(caplog):
    rail = joint("rail", "prismatic", "base", "car").replace('effort="10" velocity="3"', "")
    arm = joint("arm", "revolute", "car", "rod").replace('effort="10" velocity="3"', "")
    tip = joint("massless", "revolute", "rod", "tip")
    parts = [link("base"), link("car"), link("rod"), '<link name="tip"/>', rail, arm, tip]
    chain = RigidChain(robot(*parts), damping=2.0)
    envelope = Envelope(chain, MotionLimits(share=0.5))
    assert envelope.velocity.tolist() == [0.1, 0.5, 1.5]
    assert envelope.acceleration.tolist() == pytest.approx([0.3, 1.5, 4.5])
    first, second = (record.getMessage() for record in caplog.records)
    assert "no velocity limit of rail, arm:" in first
    assert "the torque of rail, arm, massless is not limited" in second
    q, v = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(0)).double()
    friction = envelope.torque_for(q, v, 0 * q) - chain.rigid_force(q, v, 0 * q)
    torch.testing.assert_close(friction, 2 * v)


def test_ctrl_c_returns_the_best_motion_so_far(monkeypatch):
    calls = itertools.count()

    def interrupt(*_):
        if next(calls) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr("pinn_dyn.progress.Progress.update", interrupt)
    motion = pinn_dyn.design_excitation(ARM, duration=3.0, steps=1000)
    assert next(calls) == 4
    assert motion.excitation.condition < motion.random_condition


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(limits={"torque": [1.0, 2.0]}), "torque has 2 numbers"),
        (dict(start={"bend": 1.9}), "the start of bend"),
        (dict(limits={"lowest_tip": 2.0}), "the tip starts below"),
    ],
)
def test_limits_that_cannot_hold_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        pinn_dyn.design_excitation(ARM, **arguments)


def test_files_and_figure_are_written(design, tmp_path):
    design.save(tmp_path, rate=200.0)
    table = np.genfromtxt(tmp_path / "motion.csv", delimiter=",", names=True)
    assert table.dtype.names[:3] == ("t", "q_turn", "q_lift")
    assert {"a_bend", "tau_bend"} < {*table.dtype.names}
    assert table["t"][1] == 0.005
    np.testing.assert_allclose(table["tau_lift"], design.tau[::5, 1], atol=1e-6)
    assert (tmp_path / "motion.png").stat().st_size > 10_000
    assert yaml.safe_load((tmp_path / "joint_trajectory.yaml").read_text())["points"]
