"""Robots of run folders that simulators would load: C++ code, which no foreign file reaches."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from pinn_dyn.run.run_folder import load_run
from pinn_dyn.systems import RigidChain, robot_files
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


ENDLESS = '<mujoco><worldbody><replicate count="1000000000"><geom size="1"/></replicate>'
ENDLESS += '<body><joint name="a"/><geom size="1"/></body></worldbody></mujoco>'


@pytest.fixture
def unread(monkeypatch):
    """MuJoCo reads no file."""
    text = "pinn_dyn.systems.urdf_file.mjcf_to_urdf"
    monkeypatch.setattr(text, lambda *_: pytest.fail("MuJoCo was started"))


@pytest.mark.usefixtures("unread")
@pytest.mark.parametrize("encoding", [None, "utf-8", "utf-16"])
def test_no_mjcf_of_a_run_folder_is_read(tmp_path, lnn_run, encoding):
    """An MJCF as text, or as a file that the configuration names."""
    file = tmp_path / "robot.xml"
    file.write_bytes(f" {ENDLESS}".encode(encoding or "utf-8"))
    structure = {
        "_target_": "pinn_dyn.systems.RigidChain",
        "urdf": str(file) if encoding else f" \n{ENDLESS}",
    }
    model = {"_target_": "pinn_dyn.models.KnownMechanics", "structure": structure}
    run = foreign(lnn_run, tmp_path / "run", lambda config: config.update(model=model))
    message = r"model\.structure\.urdf is an MJCF, .*add trust=pinn_dyn\.systems\.RigidChain"
    with pytest.raises(ValueError, match=message):
        load_run(run)


@pytest.mark.usefixtures("unread")
def test_an_export_reads_no_mjcf_that_the_urdf_of_a_run_names(tmp_path):
    (tmp_path / "robot.xml").write_text(ENDLESS)
    arm = RigidChain(f"<!-- {tmp_path}/robot.xml -->{PENDULUM[PENDULUM.index('<robot') :]}")
    assert str(robot_files._file(arm).path) == "URDF text"


@pytest.mark.parametrize("simulator", SIMULATORS)
def test_a_name_of_a_joint_is_no_mesh(simulator):
    name = MESH.replace('"', "&quot;").replace("<", "&lt;")
    arm = simulated_by(simulator)(PENDULUM.replace('"shoulder"', f'"{name}"'))
    assert arm.joint_names[0] == MESH
    assert not ET.fromstring(arm.text).findall(".//mesh")
    arm.set_state(*np.ones((2, 2)))
