"""Recorded data of a simulated arm: limits, splits, cache and processes."""

import importlib
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import hydra
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from pinn_dyn.app.config import CONF
from pinn_dyn.data import (
    RobotExcitation,
    RobotSource,
    SimulationError,
    TrackedMultiSine,
)
from pinn_dyn.data.cache import load_or_make
from pinn_dyn.data.robot_excitation import DrawnMotion
from tests.support.processes import fork
from tests.support.simulated_arms import SIMULATORS, SPATIAL, simulated_by

TRACKED = {
    "frequency": [0.05, 0.5],
    "harmonics": 4,
    "reach": 0.9,
    "amplitude": [0.33, 1.0],
    "speed": 0.5,
    "torque": 0.9,
    "bandwidth": 10.0,
}
FINGERS = ["panda_finger_joint1", "panda_finger_joint2"]
SHORT = {"duration": 0.3, "train": 4, "validation": 2, "test": 2}


def build(cache, dataset="panda_mujoco", **changes):
    """The data set of conf/dataset with its own excitations, short, built as the app does."""
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        composed = hydra.compose(f"dataset/{dataset}").dataset
    OmegaConf.set_struct(composed, False)
    config = OmegaConf.merge(composed, {**SHORT, "cache": str(cache)}, changes)
    config = OmegaConf.to_container(config, resolve=True)
    return hydra.utils.instantiate(config, _convert_="all")


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    pytest.importorskip("mujoco", reason="the mujoco extra is not installed")
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def source(cache):
    return build(cache)


@pytest.fixture(scope="module")
def splits(source):
    return source.load()


def everything(splits):
    return [*splits.train, *splits.validation, *splits.test]


def moved(source, excitation, steps, *seeds):
    """q, v and u of motions of 10 s that the robot follows, ``(K, T, N)`` each."""
    t = np.arange(10001) * 1e-3
    plan = excitation.draw(source.system, t, [np.random.default_rng(seed) for seed in seeds])
    return source._record(plan, t[:steps])


def recorded(source, split):
    """q, v and u as the simulator gave them, from the cache."""
    arrays = load_or_make(Path(source.cache), source.name, source.describe(), source.simulate)
    return (torch.from_numpy(arrays[f"{split}_{key}"]) for key in "qvu")


@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_records_satisfy_the_equation_of_motion_with_the_recorded_torque(source, splits, split):
    """u is the motor's torque alone: the friction is in D, and is not zero."""
    assert float(source.system.damping_matrix(torch.zeros(7)).diagonal().min()) > 0
    q, v, u = recorded(source, split)
    a = source.system.forward_dynamics(q[:, :-1], v[:, :-1], u[:, :-1])
    torch.testing.assert_close(v[:, 1:], v[:, :-1] + 1e-3 * a, rtol=0, atol=1e-8)
    torch.testing.assert_close(q[:, 1:], q[:, :-1] + 1e-3 * v[:, 1:], rtol=0, atol=1e-12)


def test_position_velocity_and_torque_limits_hold(source, splits):
    robot = source.system
    for item in everything(splits):
        q, v, u = (x.numpy() for x in (item.q, item.v, item.u))
        assert ((q > robot.q_low) & (q < robot.q_high)).all()
        assert (np.abs(v) <= robot.v_max).all()
        assert (np.abs(u) <= robot.u_max).all()


def test_references_use_the_speed_and_range_allowed(source):
    """The fraction of the limits is reached by some joint and passed by none."""
    robot = source.system
    q, v, _ = moved(source, TrackedMultiSine(**TRACKED), 5000, 0, 1, 2)
    peak = (np.abs(v) / robot.v_max).max()
    assert 0.49 < peak <= 0.505  # tracked, so not exactly the reference
    extent, low, high = robot.q_high - robot.q_low, q.min((0, 1)), q.max((0, 1))
    assert (low > robot.q_low + 0.04 * extent).all()
    assert (high < robot.q_high - 0.04 * extent).all()
    assert (high - low > 0.3 * extent).all()


def test_a_tight_torque_limit_slows_the_reference_down(source):
    settings = {**TRACKED, "frequency": [1, 2], "speed": 1.0}
    (q, v, _), (q_slow, v_slow, u_slow) = (
        moved(source, TrackedMultiSine(**{**settings, "torque": torque}), 1000, 5)
        for torque in (1.0, 0.5)
    )
    np.testing.assert_array_equal(q[:, 0], q_slow[:, 0])
    assert (np.abs(v_slow[:, 0]) < 0.95 * np.abs(v[:, 0])).all()
    assert (np.abs(u_slow) <= 0.505 * source.system.u_max).all()


def test_a_second_load_reads_the_cache(cache, splits, monkeypatch):
    def fail(self):
        raise AssertionError("recorded again")

    monkeypatch.setattr(RobotSource, "simulate", fail)
    again = build(cache).load()
    assert torch.equal(again.test[0].q, splits.test[0].q)
    assert torch.equal(again.test[0].v, splits.test[0].v)


def test_a_recording_of_another_simulator_is_made_again(tmp_path, monkeypatch, caplog):
    pytest.importorskip("mujoco", reason="the mujoco extra is not installed")
    before = build(tmp_path, duration=0.05).load().train[0].q
    kind = type(build(tmp_path).system)
    step = kind.step
    monkeypatch.setattr(kind, "step", lambda self, force, h: step(self, 0.9 * force, h))
    assert not torch.equal(build(tmp_path, duration=0.05).load().train[0].q, before)
    assert "made again" in caplog.text


def test_what_changes_the_motion_changes_the_key(source, cache):
    changes = [
        {"seed": 1},
        {"duration": 0.6},
        {"step": 0.0005},
        {"system": {"damping": 0.1}},
        {"system": {"gravity": [0, 0, 0]}},
        {"system": {"payload": 1.0}},
        {"system": {"u_max": 50.0}},
        {"system": {"locked_joints": [*FINGERS, "panda_joint3"], "damping": 0.5}},
    ]
    for change in changes:
        found = build(cache, configurations=None, **change).describe()
        assert found != source.describe(), change


@pytest.mark.parametrize("name", SIMULATORS)
def test_any_urdf_by_path(cache, name):
    system = {
        "_target_": f"pinn_dyn.systems.{simulated_by(name).__name__}",
        "urdf": SPATIAL,
        **{"v_max": 3.0, "u_max": [40.0, 20.0]},
    }
    arm = build(cache, "urdf_arm", name="spatial", system=system, train=2, test=1)
    assert list(arm.configurations) == ["middle"]
    q, v, u = recorded(arm, "test")
    a = arm.system.forward_dynamics(q[:, :-1], v[:, :-1], u[:, :-1])
    torch.testing.assert_close(v[:, 1:], v[:, :-1] + 1e-3 * a, rtol=0, atol=1e-8)


@pytest.mark.panda
def test_both_simulators_record_the_same_panda(source):
    """The draws are the same, and the steps differ by rounding."""
    simulated_by("BulletArm")
    bullet = build(source.cache, "panda", duration=0.1)
    pairs = zip(build(source.cache, duration=0.1).load().train, bullet.load().train, strict=True)
    for mujoco, other in pairs:
        torch.testing.assert_close(mujoco.q, other.q, rtol=0, atol=1e-10)
        torch.testing.assert_close(mujoco.u, other.u, rtol=0, atol=1e-6)


# Bad input.


def test_a_urdf_without_torque_limits_is_refused(cache, tmp_path):
    path = tmp_path / "weak.urdf"
    path.write_text(
        """<robot name="weak"><link name="base"/>
        <link name="rod"><inertial><mass value="1"/>
          <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
        <joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/>
          <axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="2"/></joint></robot>"""
    )
    with pytest.raises(
        hydra.errors.InstantiationException, match=r"the joints hinge have no velocity or torque"
    ):
        build(cache, "urdf_arm", system={"urdf": str(path)})
    limits = build(cache, "urdf_arm", system={"urdf": str(path), "u_max": 20.0}).system.limits
    assert limits.tolist() == [[-1, 1, 2, 20]]


@dataclass(frozen=True)
class Push(RobotExcitation):
    """Full torque all the time, which no arm survives."""

    def draw(self, robot, t, rngs):
        middle = np.tile((robot.q_low + robot.q_high) / 2, (len(rngs), 1))
        return DrawnMotion(middle, 0 * middle, lambda k, q, v: 1000 * robot.u_max)


def test_motions_beyond_the_limits_are_given_up_by_joint(cache):
    source = build(cache)
    source.excitations = [*source.excitations, Push()]
    with pytest.raises(
        SimulationError, match=r"\d motions of Push leave .* of .*panda_joint\d.* 20 draws: lower"
    ):
        source.simulate()


def test_a_robot_too_weak_to_hold_itself_is_reported(source):
    weak = TrackedMultiSine(**{**TRACKED, "torque": 0.1})
    with pytest.raises(ValueError, match=r"of the torque allowed at joint 'panda_joint5'"):
        weak.draw(source.system, np.arange(101) * 1e-3, [np.random.default_rng(0)])


def test_everything_else_imports_without_a_simulator(tmp_path):
    """In a process where importing simulators fails, and that has imported nothing of ours."""

    def work():
        for name in [name for name in sys.modules if name.split(".")[0] == "pinn_dyn"]:
            del sys.modules[name]
        for name in ("pybullet", "pybullet_data", "mujoco", "gymnasium"):
            sys.modules[name] = None
        for name in ("app.train", "run.training.trainer", "data", "evaluation"):
            importlib.import_module(f"pinn_dyn.{name}")
        systems = importlib.import_module("pinn_dyn.systems")
        systems.SoftArm()
        for name, extra in (("BulletArm", "panda"), ("MujocoArm", "mujoco")):
            with pytest.raises(ImportError, match=re.escape(f"pip install 'pinn_dyn[{extra}]'")):
                getattr(systems, name)("franka_panda/panda.urdf")
        with pytest.raises(ImportError, match=re.escape("pip install 'pinn_dyn[envs]'")):
            importlib.import_module("pinn_dyn.envs")

    with (tmp_path / "said.txt").open("w") as output:
        process = fork(work, output)
        process.join(600)
    assert process.exitcode == 0, (tmp_path / "said.txt").read_text()
