"""Advice of messages: overrides that a message suggests are applied to the command that failed."""

import re

import pandas as pd
import pytest

from tests.app.entry import NO_FIGURES, ROOT, SET_POINTS, TINY, fails, run_script
from tests.support.contracts import slow_except
from tests.support.delayed_robots import log

OVERRIDE = re.compile(r"~[\w/.]+|\b[a-z]\w*(?:[./]\w+)*=(?:\[[^]]*\]|[^\s,;:'\"]+)")
ADVICE = re.compile(
    r"(?::|,|;) (?=set|use|give|write|such as|expected|train|add|leave|reduce|raise|change|name)"
)
LOG = ["dataset=example_log", "data.pairs=64", "data.batch_size=32", "data.stride=5"]
LOG += ["validator.horizon=0.1", "validator.window=null", "validator.step=null"]
LOG += ["trainer.steps=2", "trainer.validations=1"]
PENDULUM = ROOT / "examples" / "double_pendulum.urdf"
KNOWN = ["dataset=csv_log", "dataset.root={folder}", "dataset.files=arm.csv", *LOG[1:]]
KNOWN += ["dataset.q.columns=[q1,q2]", "dataset.q.unit=rad", "dataset.u.columns=[u1,u2]"]
for part in ("validation", "test"):
    KNOWN += [f"+dataset.{part}.seconds=2.0", f"dataset.{part}.piece=1.0"]
KNOWN += ["model=known", "data.steps=1", "model/structure=urdf", f"model.structure.urdf={PENDULUM}"]
FIT = ["train.py", *KNOWN, "dataset.u.unit=Nm", "optimizer=least_squares"]
SHORT = ["steps=2", "duration=3"]
ROBOT = f"model.structure.urdf={PENDULUM}"
STEP = ["duration=0.05", "settled_after=0.03", "animate=false", "rate=200"]
LOOP = ["run={lnn}", *SET_POINTS, "~controllers.truth", "~controllers.pd", "runs=1"]
COMMANDS = {
    "no momenta": ["train.py", *LOG, "model=hnn", "model.state=qp"],
    "midpoint, no derivative": ["train.py", *TINY, "model=mlp", "loss=midpoint"],
    "least squares of a network": ["train.py", *TINY, "model=lnn", "optimizer=least_squares"],
    "inputs in ampere": ["train.py", *KNOWN, "dataset.u.unit=A"],
    "memory without history": ["train.py", *LOG, "model=subnet", "data.history=0.01"],
    "no compiler": ["train.py", *TINY, "model=mlp", "compile=true"],
    "option of a group": ["train.py", *TINY, "model=lnn", "model.damping=constant"],
    "chain of M^-1": ["train.py", *TINY, "model=hnn", "model.inverse_mass.transposed=true"],
    "no structure": ["excite.py", *SHORT],
    "a joint without an input": ["train.py", *KNOWN, "dataset.u.columns=[u1]", "dataset.u.unit=Nm"],
    "a column too few": [
        *("train.py", *KNOWN, "dataset.q.columns=[q1]", "dataset.u.columns=[u1]"),
        "dataset.u.unit=Nm",
    ],
    "validations that do not divide the steps": [
        *("train.py", *TINY, "model=lnn", "trainer.steps=3", "trainer.validations=2"),
    ],
    "loss that diverges": ["train.py", *TINY, "model=lnn", "optimizer.lr=1e12", "trainer.steps=9"],
    "too few windows": [*FIT, "data.pairs=9", "data.batch_size=9"],
    "too few samples": [*FIT, "optimizer.rollouts=false", "optimizer.samples=9"],
    "no run": ["control.py", *SET_POINTS, "rate=200"],
    "no set point": ["control.py", "run={lnn}", *STEP],
    "gains that let the loop diverge": [
        *("control.py", *LOOP, "rate=100"),
        *("gains.position=2e4", "gains.velocity=300", "controllers.learned.terms=truth"),
    ],
    "start outside the limits": ["excite.py", ROBOT, *SHORT, "start=10"],
    "too few periods": ["excite.py", ROBOT, "steps=2", "duration=1"],
}
# Settings that a message names without a value.
VALUES = {
    "model.structure.urdf=...": f"model.structure.urdf={PENDULUM}",
    "driven_joints=[...]": "model.driven_joints=[shoulder]",
    "more windows (data.pairs)": "data.pairs=16 data.batch_size=16",
    "longer windows (data.steps)": "data.steps=2",
    "raise optimizer.samples": "optimizer.samples=500",
    "run=...": "run={lnn}",
    "reference.q=[...]": "reference.q=[0,0,0.2]",
    "leave it out": "~actuator.rate",
    "give a rate": "rate=200",
    "change the rate": "rate=200",
    "reduce optimizer.lr": "optimizer.lr=0.001",
    "reduce the gains": "gains.position=5 gains.velocity=0.5",
    "raise the rate": "rate=2000",
    "a pose within them": "start=0.0001",
    "raise duration": "duration=3",
    "frequency": "frequency=2.0",
}


def suggestions(message):
    """Return the overrides that the end of a message suggests, for each alternative."""
    *_, advice = ADVICE.split(message)
    for placeholder, value in VALUES.items():
        advice = advice.replace(placeholder, value)
    matches = [OVERRIDE.findall(part) for part in re.split(r"[,;]? or ", advice)]
    return [match for match in matches if match]


def applied(words, overrides):
    """Return the words with overrides, without those of the same place."""
    places = [re.sub(r"=.*|^~", "", x).replace("/", ".") for x in overrides]
    kept = [
        word
        for word in words
        if not any(f"{word.split('=')[0].replace('/', '.')}.".startswith(f"{x}.") for x in places)
    ]
    present = {word.split("=")[0] for word in words}
    return [*kept, *(x for x in overrides if x[0] != "~" or x[1:] not in present)]


def filled(word, folders):
    """Return a word of a command with the folders that it names, such as {lnn}."""
    return re.sub(r"\{(\w+)\}", lambda match: str(folders[match[1]]), word)


@pytest.fixture
def runs(lnn_run):
    return {"lnn": lnn_run}


FAST = (
    *("no momenta", "midpoint, no derivative", "least squares of a network", "inputs in ampere"),
    *("memory without history", "no compiler", "option of a group", "chain of M^-1"),
    *("a joint without an input", "loss that diverges", "no set point", "rate of an actuator"),
    *("start outside the limits", "too few periods"),
)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("name", slow_except(COMMANDS, FAST))
def test_the_suggested_override_works(name, tmp_path, monkeypatch, runs):
    if name == "no compiler":
        monkeypatch.setattr("pinn_dyn.run.training.trainer.has_cpp_compiler", lambda: False)
    arm = log("arm", 0, 0.05)
    table = {"t": arm.t, "q1": arm.q[:, 0], "q2": arm.q[:, 1], "u1": arm.u[:, 0], "u2": arm.u[:, 1]}
    pd.DataFrame(table).to_csv(tmp_path / "arm.csv", index=False)
    runs["folder"] = tmp_path
    script, *words = [filled(word, runs) for word in COMMANDS[name]]
    if script == "train.py":
        words.append(NO_FIGURES)
    message = str(fails(script, *words, f"hydra.run.dir={tmp_path / 'refused'}").code)
    choices = suggestions(message)
    assert choices, message
    for k, overrides in enumerate(choices):
        folder = tmp_path / str(k)
        overrides = [filled(word, runs) for word in overrides]
        run_script(script, *applied(words, overrides), f"hydra.run.dir={folder}")
        assert (folder / "config.yaml").is_file()
