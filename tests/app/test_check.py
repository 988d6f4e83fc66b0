"""check.py: a verdict on a log, its page, and an error where a training makes no sense."""

import re
import shlex

import numpy as np
import pandas as pd
import pytest
from scipy.signal import lfilter

from pinn_dyn import load
from pinn_dyn.models import CoulombFriction, ElasticJoints, Servo
from tests.app.entry import NO_FIGURES, ROOT, fails, run_script
from tests.support.delayed_robots import log, resting

COLUMNS = [
    "dataset.q.columns=[q1,q2]",
    "dataset.q.unit=rad",
    "dataset.u.columns=[u1,u2]",
    "dataset.u.unit=Nm",
    "+dataset.validation.seconds=2.0",
    "dataset.validation.piece=1.0",
    "+dataset.test.seconds=2.0",
    "dataset.test.piece=1.0",
]


def structure(name):
    return ["model/structure=urdf", f"model.structure.urdf={ROOT / 'examples' / name}.urdf"]


def arguments(folder, **columns):
    """A log of the arm whose torques act 50 ms late, some columns changed, and how to read it."""
    item = log("arm", 0, 0.05)
    table = {"t": item.t, "q1": item.q[:, 0], "q2": item.q[:, 1]}
    table |= {"u1": item.u[:, 0], "u2": item.u[:, 1]}
    pd.DataFrame(table | columns).to_csv(folder / "arm.csv", index=False)
    words = ["dataset=csv_log", f"dataset.root='{folder}'", "dataset.files=arm.csv", *COLUMNS]
    return [*words, f"hydra.run.dir={folder / 'out'}"]


def test_a_log_gets_a_verdict_a_page_and_a_step_to_copy(tmp_path, capsys):
    run_script("check.py", *arguments(tmp_path))
    text = capsys.readouterr().out
    assert "a training makes sense, 2 warnings" in text
    assert re.search(r"^delay: 0\.0[45]", text, re.MULTILINE)
    page = (tmp_path / "out" / "check.html").read_text()
    assert 'id="delays"' in page
    assert "delay: 0.0" in page
    assert page.count("<img") == 4


def printed_training(folder, capsys, table, effects, *settings):
    """Follow the advice of check.py for a log for one step, and return the model."""
    table.to_csv(folder / "joints.csv", index=False)
    words = ["dataset=csv_log", f"dataset.root='{folder}'", "dataset.files=joints.csv", *COLUMNS]
    run_script("check.py", *words, *settings, f"hydra.run.dir={folder / 'out'}")
    (command,) = re.findall(rf"a training.* {effects}: python (.*)", capsys.readouterr().out)
    script, *words = shlex.split(command)
    small = ["trainer.steps=1", "trainer.validations=1", "data.pairs=64", "data.batch_size=64"]
    small += ["compile=false"] if "model=lnn" in words else ["optimizer.rollouts=false"]
    small += ["validator.horizon=0.1", NO_FIGURES, f"hydra.run.dir={folder / 'run'}"]
    run_script(script, *words, *small)
    return load(folder / "run").model


@pytest.mark.usefixtures("undrawn")
def test_the_printed_training_has_the_friction_of_the_log(tmp_path, capsys):
    item = resting(0.3)
    table = {"t": item.t, "q1": item.q[:, 0], "q2": item.q[:, 1]}
    table |= {"u1": item.u[:, 0], "u2": item.u[:, 1]}
    model = printed_training(tmp_path, capsys, pd.DataFrame(table), "dry friction")
    assert isinstance(model.friction, CoulombFriction)


@pytest.mark.usefixtures("undrawn")
def test_the_printed_training_has_the_servos_of_the_log(tmp_path, capsys):
    t = np.arange(3000) / 100
    table = {"t": t}
    for k, frequency in ((1, 0.31), (2, 0.47)):
        target = 0.4 * np.sin(6.28 * frequency * t) + 0.3 * np.sin(6.28 * 1.7 * frequency * t)
        poles = lfilter([0.0, 0.02], [1, -1.75, 0.77], target)  # a lag of a few samples
        table |= {f"q{k}": poles, f"u{k}": target}
    effects, unit = "targets of servos.*", "dataset.u.unit=rad"
    model = printed_training(tmp_path, capsys, pd.DataFrame(table), effects, unit)
    assert isinstance(model.input, Servo)


def test_inputs_of_another_robot_end_in_an_error(tmp_path, capsys):
    rng = np.random.default_rng(0)
    noise = {f"u{k}": rng.normal(size=1201) for k in (1, 2)}
    error = fails("check.py", *arguments(tmp_path, **noise))
    assert "the inputs explain" in str(error.code)
    assert (tmp_path / "out" / "check.html").is_file()


def test_a_structure_of_another_robot_is_refused_by_name(tmp_path):
    error = fails("check.py", *arguments(tmp_path), *structure("emps"))
    assert "the columns q1, q2, and the structure the joints screw" in str(error.code)


def test_known_kinematics_add_what_the_motion_tells_of_the_bodies(tmp_path, capsys):
    run_script("check.py", *arguments(tmp_path), *structure("double_pendulum"))
    text = capsys.readouterr().out
    assert "Rigid bodies" in text
    assert "not determined: none" in text
    assert "Rigid bodies" in (tmp_path / "out" / "check.html").read_text()


def test_a_simulated_data_set_is_refused():
    assert "is simulated, expected a log" in str(fails("check.py", "dataset=soft_arm_1").code)


@pytest.mark.slow
def test_the_constants_of_elastic_joints_are_trained_as_printed(tmp_path, capsys):
    item = log("arm", 0, 0.0)
    q, motors = item.q.T, (item.q + item.u / 300).T
    table = {"t": item.t, "q1": q[0], "q2": q[1], "m1": motors[0], "m2": motors[1]}
    table |= {"u1": item.u[:, 0], "u2": item.u[:, 1]}
    words = ["model/structure=elastic", "dataset.q.columns=[q1,q2,m1,m2]"]
    words += [structure("double_pendulum")[1].replace("urdf=", "chain.urdf=", 1)]
    model = printed_training(tmp_path, capsys, pd.DataFrame(table), "its constants", *words)
    assert isinstance(model.structure, ElasticJoints)


@pytest.mark.usefixtures("undrawn")
def test_the_remedy_for_a_delay_is_followed(tmp_path, capsys):
    words = [*arguments(tmp_path), "data.pairs=64", "data.batch_size=64", "trainer.steps=1"]
    run_script("check.py", *words[:-3])
    text = capsys.readouterr().out
    delay = re.search(r"^delay: (.*) # s", text, re.MULTILINE)[1]
    words += ["model=lnn", "trainer.validations=1", "validator.horizon=0.1", NO_FIGURES]
    run = tmp_path / "run"
    run_script("train.py", *words, f"dataset.delay={delay}", f"hydra.run.dir={run}")
    np.testing.assert_allclose(load(run).input_delay, 0.05, atol=0.01)
