"""Advice of messages about Python calls, packages and files: followed as a user would."""

import re
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

import pinn_dyn
from pinn_dyn.data.logs import LogError, LogSource
from pinn_dyn.systems import BulletArm, RigidChain
from tests.app.entry import ROOT
from tests.support.rigid_chains import joint, link, robot

ARM = robot(link("base"), link("rod"), joint("hinge", "continuous", "base", "rod"))
MJCF = "<mujoco><worldbody><body><joint/><inertial mass='1' pos='0 0 1' diaginertia='1 1 1'/>"
MJCF += "</body></worldbody></mujoco>"
EXTRAS = (ROOT / "pyproject.toml").read_text().partition("[project.optional-dependencies]")[2]
EXTRAS = dict(re.findall(r"^(\w+) = (\[.*\])", EXTRAS, re.MULTILINE))


def load(path):
    path.touch()
    part = {"seconds": 1.0, "piece": 1.0}
    columns = {"q": {"columns": "q", "unit": "rad"}, "u": {"columns": "u", "unit": "Nm"}}
    return LogSource(
        name="arm",
        root=str(path.parent),
        files=path.name,
        time={"columns": "t", "unit": "s"},
        **columns,
        validation=part,
        test=part,
    ).load()


# Module that is missing, its name on PyPI, and a call that needs it.
PACKAGES = [
    ("rosbags", "rosbags", lambda folder: load(folder / "run.bag")),
    ("mcap", "mcap", lambda folder: load(folder / "run.mcap")),
    ("h5py", "h5py", lambda folder: load(folder / "run.h5")),
    ("pyarrow.parquet", "pyarrow", lambda folder: load(folder / "run.parquet")),
    ("matio", "mat-io", lambda folder: load(folder / "run.mat")),
    ("mujoco", "mujoco", lambda _: RigidChain(MJCF)),
    ("pybullet", "pybullet", lambda _: BulletArm(ARM)),
]


@pytest.mark.parametrize(("module", "package", "call"), PACKAGES, ids=[x[1] for x in PACKAGES])
def test_the_extra_of_a_message_contains_the_missing_package(
    module, package, call, tmp_path, monkeypatch
):
    for name in [x for x in sys.modules if f"{x}.".startswith(f"{module}.")] or [module]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises((ImportError, LogError), match="pip install") as error:
        call(tmp_path)
    extra = re.search(r"pip install 'pinn_dyn\[(\w+)\]'", str(error.value))[1]
    assert f'"{package}' in EXTRAS[extra]


def test_all_extras_that_the_package_names_exist():
    texts = [path.read_text() for path in (ROOT / "pinn_dyn").rglob("*.py")]
    names = {x for text in texts for x in re.findall(r"pinn_dyn\[(\w+)\]", text)}
    assert names >= {"logs", "mujoco", "panda"}
    assert names <= set(EXTRAS)


def test_the_command_for_a_xacro_file_makes_a_robot_that_loads(tmp_path, monkeypatch):
    """The shell runs the command as printed, with a program that prints the expanded robot."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "my arm.urdf.xacro"
    path.write_text(
        ARM.replace("<link", '<xacro:arm xmlns:xacro="http://wiki.ros.org/xacro"/><link', 1)
    )
    (tmp_path / "plain.urdf").write_text(ARM)
    program = tmp_path / "xacro"
    program.write_text('#!/bin/sh\n[ -f "$1" ] && cat plain.urdf\n')
    program.chmod(0o755)
    with pytest.raises(ValueError, match="is a xacro file") as error:
        RigidChain(str(path))
    command = re.search(r"convert it by (.*)", str(error.value))[1]
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    subprocess.run(command, shell=True, check=True)
    assert RigidChain("robot.urdf").joint_names == ["hinge"]


def test_an_ensemble_has_the_interval_that_a_single_network_has_not(lnn_run, run_of):
    start, t = np.array([0.0, 0, 0.2, 0, 0, 0]), np.arange(20) * 0.002
    u = np.zeros((20, 3))
    with pytest.raises(TypeError, match="train several seeds") as error:
        pinn_dyn.load(lnn_run).predict_interval(start, u, t)
    call = re.search(r"take (ensemble\(runs\))", str(error.value))[1]
    runs = [pinn_dyn.load(folder) for folder in (lnn_run, run_of("other seed"))]
    run = eval(f"pinn_dyn.{call}", {"pinn_dyn": pinn_dyn, "runs": runs})
    low, high = run.predict_interval(start, u, t)
    assert (low < high)[1:].any()
    with pytest.raises(TypeError, match="expected predict") as error:
        run.predict(start, t=t)
    call = re.search(r"expected (predict\(.*\))", str(error.value))[1]
    names = {"predict": run.predict, "start": start, "u": u, "t": t}
    assert eval(call, names).shape == (20, 6)
    with pytest.raises(ValueError, match="give start, u and t"):
        run.predict(pd.DataFrame({"t": t}))
