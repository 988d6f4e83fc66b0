"""Every example runs with a training of two steps and prints plausible numbers."""

import contextlib
import io
import re
import runpy
import shutil
import sys
from pathlib import Path

import pandas as pd
import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from pinn_dyn import check
from pinn_dyn.exports.c_file import find_compiler
from tests.app.entry import ROOT, compose, own_logging

EXAMPLES = ROOT / "examples"
RUN = "runs/own_log"


@pytest.fixture(scope="module", autouse=True)
def home(tmp_path_factory):
    """A folder for the files and caches of the examples."""
    folder = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("HOME", str(folder))
        patch.setenv("PINN_DYN_CACHE", str(folder / "cache"))
        log = pd.read_csv(EXAMPLES / "example_log.csv")
        log[log.t <= 1.0].to_csv(folder / "example_log.csv", index=False)  # of 5 s
        for file in [*EXAMPLES.glob("*.py"), EXAMPLES / "double_pendulum.urdf"]:
            shutil.copy(file, folder)
        yield folder


def run(name, *arguments):
    with (
        pytest.MonkeyPatch.context() as patch,
        own_logging(),
        contextlib.redirect_stdout(io.StringIO()) as out,
    ):
        patch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(name, run_name="__main__")
    return out.getvalue()


@pytest.fixture(scope="module")
def own_log(home):
    """Output of own_log.py, whose run folder other examples load."""
    return run("own_log.py", "--steps", "2")


def test_own_log(own_log):
    assert len(re.findall(r"mean error \{'bend_x': \d+.*constant velocity", own_log)) == 2


def test_load_and_predict(own_log):
    assert "stretch [m]" in run("load_and_predict.py", RUN)


def test_torque_feedforward(own_log):
    """Even an untrained model follows its own inverse dynamics for a while."""
    text = run("torque_feedforward.py", RUN)
    distances = re.search(r"from the path: \[(.*)\]", text)[1].split()
    assert max(map(float, distances)) < 0.1


def test_a_regulator_that_diverges_ends_with_an_error(own_log):
    with pytest.raises(SystemExit, match=r"diverged.* at t = .*: train on a log that moves all"):
        run("regulator_in_a_loop.py", RUN, "--duration=0.5", "--gains", "1e5", "1e3")


@pytest.mark.slow
def test_the_example_log_determines_a_model_that_controls(home):
    """The regulator holds its set point after 400 of the 1,000 steps of the example."""
    folder = home / "whole_log"  # own_log.py reads the log beside it
    folder.mkdir()
    for name in ("own_log.py", "example_log.csv"):
        shutil.copy(EXAMPLES / name, folder)
    run(str(folder / "own_log.py"), "--folder", "runs/whole", "--steps", "400")
    text = run("regulator_in_a_loop.py", "runs/whole", "--duration=2", "--gains", "5", "0.4")
    errors = re.search(r"final error: \[(.*)\]", text)[1].split()
    assert max(map(float, errors)) < 0.01  # of steps of 0.4 and 0.3 rad
    assert "largest distance" in run("torque_feedforward.py", "runs/whole")


@pytest.mark.skipif(not find_compiler(), reason="the example needs a C compiler")
def test_export_and_call(own_log, few_states):
    assert "the same as before the export: True" in run("export_and_call.py", RUN)


@pytest.mark.slow
def test_simulate_and_learn():
    text = run("simulate_and_learn.py", "--steps", "2", "--duration", "2.0")
    assert "mean error over 2 s: {'Δx [rad]'" in text


def test_passive_pendulum():
    assert "constant within" in run("passive_pendulum.py", "--steps", "2")


def test_own_robot():
    assert "M learned" in run("own_robot.py", "--steps", "2")


@pytest.mark.slow
def test_lqr():
    """The gains of the true robot balance it, and an untrained model has gains of finite size."""
    assert "K learned" in run("lqr.py", "--steps", "2")


def test_identified_robot():
    pytest.importorskip("pinocchio", reason="the dev extra is not installed")
    torques = re.findall(r"(?:Pinocchio|the model): \[(.*)\]", run("identified_robot.py"))
    assert len(set(torques)) == 1


@pytest.mark.skipif(not find_compiler(), reason="the example needs a C compiler")
def test_contact(home, few_states):
    """The push of 6, -9 and 8 N from 4.0 s on is the only contact."""
    text = run("contact.py")
    (contact,) = re.findall(r"the frame +(\S+) +(\S+) +q", text)
    assert 4.0 <= float(contact[0]) < 4.05 < 4.3 <= float(contact[1]) < 4.45
    force = [float(x) for x in re.search(r"force \[N\]: \[(.*)\]", text)[1].split(",")]
    assert force == pytest.approx([6.0, -9.0, 8.0], abs=0.5)
    assert (home / "contact.png").stat().st_size > 10_000


def test_motion_capture(home):
    assert "q = (mass:X [m], mass:Z [m])" in run("motion_capture.py", "--steps", "2")


def test_saturated_drive(caplog):
    without, curve = re.findall(r"m c = (\S+) kg m", run("saturated_drive.py"))
    assert abs(float(curve) - 0.3) < 0.005 < 0.3 < float(without) - 0.3
    assert caplog.text.count("input 'tau' is a command that its drive cannot follow") == 1


@pytest.mark.slow
@pytest.mark.skipif(not find_compiler(), reason="the example needs a C compiler")
def test_adaptive_tracking(home):
    errors = re.findall(r"error (\S+) mrad", run("adaptive_tracking.py"))
    assert float(errors[1]) < 2 < 50 < float(errors[0])
    assert (home / "law.c").is_file()


def test_randomized_robots(home):
    """The draws differ most in the mass of the first body, which the motion does not determine."""
    text = run("randomized_robots.py")
    masses = [float(x) for x in re.findall(r"mass of link\d: .* to .*, (\S+) %", text)]
    torque = float(re.search(r"torque: (\S+) %", text)[1])
    assert masses[0] > 10 > 2 > torque
    assert len(list((home / "draws").glob("pendulum_*.xml"))) == 5


def test_reinforcement_learning(own_log):
    pytest.importorskip("gymnasium", reason="the envs extra is not installed")
    text = run("reinforcement_learning.py", RUN, "--trials=1", "--duration=0.1")
    assert len(re.findall(r"mean return .*: -\d+\.\d+ before, -\d+\.\d+ after", text)) == 2


@pytest.mark.slow
def test_mppi(home):
    """Two control instants: the arm begins to move within its limits."""
    pytest.importorskip("mujoco", reason="the mujoco extra is not installed")
    text = run("mppi.py", "--duration", "0.04")
    assert float(re.search(r"largest speed: ([\d.]+)", text)[1]) < 1
    assert float(re.search(r"goal: ([\d.]+)", text)[1]) < 0.65


def test_train_policy(home):
    pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")
    text = run("train_policy.py", "--steps", "400", "--robots", "4")
    assert len(re.findall(r"mean return on the .* without input", text)) == 2


def test_ensemble_with_spread():
    lines = run("ensemble_with_spread.py", "--seeds", "2", "--steps", "2").splitlines()
    head = next(k for k, line in enumerate(lines) if line.split() == ["t", "error", "spread"])
    assert float(lines[head + 1].split()[2]) < float(lines[-1].split()[2])  # common start


def test_write_servo_log(home):
    """servo_arm.yaml reads the log, whose check proposes servos."""
    main = runpy.run_path("write_servo_log.py")["main"]
    main.__globals__["EPISODES"] = 5  # of 12
    main("servo_arm.parquet")
    place = f"hydra.searchpath=[file://{ROOT / 'examples' / 'conf'}]"
    config = compose(place, "dataset=servo_arm").dataset
    source = instantiate(OmegaConf.to_container(config, resolve=True), _convert_="all")
    assert "model/input=servo" in check(source).candidates[0][1]


def test_write_example_bag(home):
    """example_bag.yaml reads the bag, and selects the joints by their names."""
    main = runpy.run_path("write_example_bag.py")["main"]
    main.__globals__["SECONDS"] = 12  # of a minute
    main(Path("example_bag"))
    short = [f"dataset.{split}.seconds=4" for split in ("validation", "test")]
    place = f"hydra.searchpath=[file://{ROOT / 'examples' / 'conf'}]"
    config = compose(place, "dataset=example_bag", f"dataset.root='{home}'", *short).dataset
    source = instantiate(OmegaConf.to_container(config, resolve=True), _convert_="all")
    (train,) = source.load().train
    assert len(train.t) == 298
    assert train.q[:, 0].std() > 1.2 * train.q[:, 1].std() > 0.1  # shoulder and elbow


@pytest.mark.slow
def test_swing_up(home):
    pytest.importorskip("casadi")
    out = run("swing_up.py", "--steps", "2", "--starts", "1", "--duration", "0.1")
    assert re.search(r"upright within 0.05 rad: 0 of 1 starts", out)
    assert "largest |u|" in out
