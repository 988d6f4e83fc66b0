"""Robots of run folders that PyBullet would load: C++ code, which no foreign file reaches."""

import xml.etree.ElementTree as ET

import pytest

from pinn_dyn.app.run_folder import load_run
from tests.support.bullet_arms import PENDULUM
from tests.support.foreign_runs import foreign

pytest.importorskip("pybullet", reason="PyBullet is not installed (the panda extra)")
from pinn_dyn.systems import BulletArm, bullet_arm

pytestmark = pytest.mark.panda
MESH = '"><visual><geometry><mesh filename="/tmp/x.obj"/></geometry></visual><x y="'
SOURCE = {
    "_target_": "pinn_dyn.data.RobotSource",
    "name": "arm",
    "system": {"_target_": "pinn_dyn.systems.BulletArm", "urdf": PENDULUM},
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


def test_no_simulator_is_started_for_a_run_folder(tmp_path, lnn_run, monkeypatch):
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path / "cache"))
    run = foreign(lnn_run, tmp_path / "run", lambda config: config.update(dataset=SOURCE))
    with monkeypatch.context() as patch:
        patch.setattr(bullet_arm, "_World", lambda *_: pytest.fail("started"))
        with pytest.raises(ValueError, match=r"arm: .*add trust=pinn_dyn\.systems\.BulletArm"):
            load_run(run).source.load()
    trusted = load_run(run, trust=("pinn_dyn.systems.BulletArm",)).source.load()
    assert len(load_run(run).source.load().train) == len(trusted.train)  # from the cache


def test_a_name_of_a_joint_is_no_mesh():
    name = MESH.replace('"', "&quot;").replace("<", "&lt;")
    arm = BulletArm(PENDULUM.replace('"shoulder"', f'"{name}"'))
    assert arm.joint_names[0] == MESH
    assert not ET.fromstring(arm.text).findall(".//mesh")
