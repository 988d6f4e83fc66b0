"""The shared logs, from the shortest data set to an evaluation, with what is printed pasted."""

import re
import shlex

import pytest
import yaml

from tests.app.entry import NO_FIGURES, assert_trained, run_script
from tests.support.recorded_logs import LOGS, ROOT, needs_logs

LOG = {
    "defaults": ["csv_log", "_self_"],
    "files": "*.csv",
}


def numbered(name, count):
    return [f"{name}{k + 1}" for k in range(count)]


def columns(names, unit):
    return {"columns": names, "unit": unit}


ROBOTS = {
    "pendulum": dict(
        root="dfki_double_pendulum/sysid_design_C1_20230629",
        q=columns(numbered("q", 2), "rad"),
        v=columns(numbered("qd", 2), "rad/s"),
        u=columns(numbered("tau_cmd", 2), "Nm"),
    ),
    "axis": dict(root="emps", q=columns(["q"], "m"), u=columns(["force"], "N")),
    "panda": dict(
        root="panda_gaz",
        q=columns(numbered("q", 7), "rad"),
        v=columns(numbered("qd", 7), "rad/s"),
        u=columns(numbered("tau", 7), "Nm"),
    ),
    "trunk": dict(
        root="asl_trunk",
        q=columns(["x2", "z2", "x3", "z3"], "m"),
        u=columns(numbered("phi", 6), "deg"),
    ),
}
STRUCTURES = {
    "pendulum": ROOT / "examples" / "double_pendulum.urdf",
    "axis": ROOT / "examples" / "emps.urdf",
}


def block_of(text):
    """Return the keys and their indented lines that a user would paste, as a mapping."""
    pattern = r"^(?:steps|delay|time|q|v|u|interpolation):.*(?:\n +\S.*)*"
    return yaml.safe_load("\n".join(re.findall(pattern, text, re.MULTILINE))) or {}


def walk(folder, name, capsys):
    """Check the log and paste what is printed, until a training is printed.

    Return the number of checks and the words of the printed command.
    """
    settings = {**LOG, **ROBOTS[name]}
    settings["root"] = str(LOGS / settings["root"])
    path = folder / "dataset" / f"my_{name}.yaml"
    path.parent.mkdir()
    words = [f"--config-dir={folder}", f"dataset=my_{name}"]
    if name in STRUCTURES:
        words += ["model/structure=urdf", f"model.structure.urdf={STRUCTURES[name]}"]
    for attempt in range(1, 6):
        path.write_text(yaml.safe_dump(settings, sort_keys=False))
        error = None
        try:
            run_script("check.py", *words, f"hydra.run.dir={folder / 'check'}", checked=True)
        except SystemExit as refusal:
            error = refusal.code
        captured = capsys.readouterr()
        text = f"{captured.out}\n{error}\n{captured.err}"
        for key, value in block_of(text).items():
            old = settings.get(key)
            settings[key] = {**old, **value} if isinstance(old, dict) else value
        path.write_text(yaml.safe_dump(settings, sort_keys=False))
        if commands := re.findall(r"^a training.*: python (.*)", text, re.MULTILINE):
            return attempt, shlex.split(commands[0])
    raise AssertionError(f"no training after {attempt} checks: {text}")


@needs_logs
@pytest.mark.parametrize(
    "name", ["trunk", *(pytest.param(x, marks=pytest.mark.slow) for x in ROBOTS if x != "trunk")]
)
def test_a_log_is_trained_after_two_checks(tmp_path, capsys, name):
    attempts, (script, *words) = walk(tmp_path, name, capsys)
    assert attempts <= 2
    short = [] if "experiment=known" in words else ["trainer.steps=2", "trainer.validations=1"]
    run = tmp_path / "run"
    run_script(script, *words, *short, NO_FIGURES, f"hydra.run.dir={run}", checked=True)
    assert_trained(run, steps=2 if short else 1)
    run_script("evaluate.py", f"runs=[{run}]", f"hydra.run.dir={tmp_path / 'out'}")
    assert "constant velocity" in (tmp_path / "out" / "summary.csv").read_text()
