"""Robots of run folders that simulators would load: C++ code, which no foreign file reaches."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from pinn_dyn.app.run_folder import load_run
from tests.support.foreign_runs import foreign
from tests.support.simulated_arms import PENDULUM, SIMULATORS, simulated_by

# The first import of MuJoCo starts programs of its own, which the watch would report.
pytest.importorskip("mujoco", reason="the mujoco extra is not installed")
MESH = '"><visual><geometry><mesh filename="/tmp/x.obj"/></geometry></visual><x y="'
SOURCE = {
    "_target_": "pinn_dyn.data.RobotSource",
    "name": "arm",
    "excitations": [
        {
            "_target_": "pinn_dyn.data.TorqueMultiSine",
            "frequency": [0.1, 1.0],
            "harmonics": 2,
            "amplitude": 0.01,
            "reach": 0.1,
        }
    ],
    **{"duration": 0.01, "step": 0.001, "train": 1, "validation": 1, "test": 1},
}


@pytest.mark.parametrize("name", SIMULATORS)
def test_no_simulator_is_started_for_a_run_folder(tmp_path, lnn_run, monkeypatch, name):
    arm, target = simulated_by(name), f"pinn_dyn.systems.{name}"
    source = {**SOURCE, "system": {"_target_": target, "urdf": PENDULUM}}
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path / "cache"))
    run = foreign(lnn_run, tmp_path / "run", lambda config: config.update(dataset=source))
    with monkeypatch.context() as patch:
        patch.setattr(arm, "world", lambda *_: pytest.fail("started"))
        with pytest.raises(ValueError, match=rf"arm: .*add trust={target}"):
            load_run(run).source.load()
    trusted = load_run(run, trust=(target,)).source.load()
    assert len(load_run(run).source.load().train) == len(trusted.train)  # from the cache


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_name_of_a_joint_is_no_mesh(simulator):
    name = MESH.replace('"', "&quot;").replace("<", "&lt;")
    arm = simulated_by(simulator)(PENDULUM.replace('"shoulder"', f'"{name}"'))
    assert arm.joint_names[0] == MESH
    assert not ET.fromstring(arm.text).findall(".//mesh")
    arm.set_state(*np.ones((2, 2)))
