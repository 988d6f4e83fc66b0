"""Python without Hydra: training and loading; a fit of constants also without Lightning."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
CODE = """
import sys
from functools import partial

sys.modules.update({name: None for name in BLOCKED})  # an import of them fails

import numpy as np
import pandas as pd

import pinn_dyn
from pinn_dyn.models import KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares

t = 0.01 * np.arange(600)
log = pd.DataFrame({"t": t, "q": np.sin(t), "u": np.sin(3 * t)})
arm = RigidChain(URDF, joints=["shoulder"])
known = partial(KnownMechanics, structure=arm)
solver = LeastSquares(cutoff=6.0, rollouts=False)
choices = {"network": {"model": "acceleration", "steps": 1}}
choices["constants"] = {"model": known, "optimizer": solver}
run = pinn_dyn.fit(log, q="q", u="u", folder=FOLDER, **choices[MODEL])
assert type(pinn_dyn.load(FOLDER).model) is type(run.model)
"""


def run(folder, model, blocked):
    urdf = ROOT / "examples" / "double_pendulum.urdf"
    values = dict(BLOCKED=blocked, URDF=str(urdf), MODEL=model, FOLDER=str(folder))
    lines = [f"{name} = {value!r}" for name, value in values.items()]
    command = [sys.executable, "-c", "\n".join([*lines, CODE])]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder.parent, check=False)


def test_a_network_is_trained_and_loaded_without_hydra(tmp_path):
    process = run(tmp_path / "run", "network", ["hydra", "omegaconf"])
    assert process.returncode == 0, process.stderr


def test_constants_are_fitted_and_loaded_without_hydra_and_lightning(tmp_path):
    process = run(tmp_path / "run", "constants", ["hydra", "omegaconf", "lightning"])
    assert process.returncode == 0, process.stderr
    assert (tmp_path / "run" / "constants.csv").exists()
    assert list((tmp_path / "run" / "tensorboard").glob("events*"))


def test_a_log_is_checked_without_the_imports_of_its_page():
    code = """
import sys
sys.modules.update(hydra=None, lightning=None, matplotlib=None, markdown=None)
from pinn_dyn.data import LogSource
from pinn_dyn.log_check.check import check
source = LogSource(
    files="examples/example_log.csv",
    trajectory="run",
    time={"columns": "t", "unit": "s"},
    q={"columns": ["bend_x", "bend_y", "stretch"], "unit": ["deg", "deg", "mm"]},
    u={"columns": ["torque_x", "torque_y", "force"], "unit": ["Nm", "Nm", "N"]},
)
assert check(source).problems == []
"""
    command = [sys.executable, "-c", code]
    process = subprocess.run(command, capture_output=True, check=False, cwd=ROOT)
    assert process.returncode == 0, process.stderr
