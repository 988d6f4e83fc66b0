"""Known mechanics tell wrong units of a real log from right ones."""

import functools
import logging
from functools import partial

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

from pinn_dyn.data import draw_windows
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares
from tests.support.recorded_logs import LOGS, ROOT, needs_logs

pytestmark = needs_logs
FINGERS = ["panda_finger_joint1", "panda_finger_joint2"]
STRUCTURES = {
    "ur10e": (str(LOGS / "ur10e" / "ur10e.urdf"), []),
    "double_pendulum": (str(ROOT / "examples" / "double_pendulum.urdf"), []),
    "emps": (str(ROOT / "examples" / "emps.urdf"), []),
    "panda_gaz": ("franka_panda/panda.urdf", FINGERS),
}
GAINS = {"drive_gain": 10.0, "gain_spread": 0.5}


@functools.cache
def training_runs(name):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PINN_DYN_LOGS", str(LOGS))
        with initialize_config_dir(version_base="1.3", config_dir=str(ROOT / "conf")):
            config = compose("train", overrides=[f"dataset={name}"]).dataset
        return instantiate(OmegaConf.to_container(config, resolve=True), _convert_="all").load()


def warnings_of(caplog, name, start, force=1.0, angle=1.0):
    """The warnings of an identification with u and q, v in other units."""
    if name == "panda_gaz":
        pytest.importorskip("pybullet_data", reason="the URDF of the Panda is not installed")
    runs = [
        Trajectory(angle * x.q, angle * x.v, Signal(x.input.t, force * x.input.u))
        for x in training_runs(name).train
    ]
    path, locked = STRUCTURES[name]
    build = partial(KnownMechanics, friction=CoulombFriction, start=start)
    build = partial(build, spread=0.3 if start == "prior" else 3.0)
    build = partial(build, **(GAINS if name == "ur10e" else {}))
    windows = draw_windows(runs, count=100, steps=1, stride=5, seed=0)
    model = build(windows.statistics(), RigidChain(path, locked_joints=locked))
    LeastSquares(cutoff=4.0, rollouts=False, samples=200, evaluations=8).fit(model, runs)
    warnings = [x.getMessage() for x in caplog.records if x.levelno >= logging.WARNING]
    return [x for x in warnings if x.startswith("least squares")]


@pytest.mark.parametrize("start", ["prior", "generic"])
@pytest.mark.parametrize("name", STRUCTURES)
def test_right_units_pass(caplog, name, start):
    assert not warnings_of(caplog, name, start)


WRONG = {"mNm": {"force": 1000.0}, "deg": {"angle": 180 / torch.pi}, "sign": {"force": -1.0}}


@pytest.mark.parametrize(
    ("name", "start", "case"),
    [
        *((name, "prior", case) for name in ("ur10e", "double_pendulum") for case in WRONG),
        ("emps", "prior", "mNm"),
        ("emps", "prior", "sign"),
        ("ur10e", "generic", "mNm"),
        ("ur10e", "generic", "deg"),
        ("panda_gaz", "prior", "deg"),
    ],
)
def test_wrong_units_or_signs_are_named(caplog, name, start, case):
    (text,) = warnings_of(caplog, name, start, **WRONG[case])
    assert "check the units of u" in text or "check the signs" in text
