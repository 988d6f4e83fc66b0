"""Advice of messages: overrides that a message suggests are applied to the command that failed."""

import re

import pandas as pd
import pytest

from tests.app.entry import NO_FIGURES, ROOT, TINY, fails, run_script
from tests.support.delayed_robots import log

OVERRIDE = re.compile(r"~[\w/]+|\b[a-z]\w*(?:[./]\w+)*=(?:\[[^]]*\]|[^\s,;:'\"]+)")
ADVICE = re.compile(r"(?::|,|;) (?=set|use|give|write|such as|expected|train|add)")
LOG = ["dataset=example_log", "data.pairs=64", "data.batch_size=32", "data.stride=5"]
LOG += ["validator.horizon=0.1", "validator.window=null", "validator.step=null"]
LOG += ["trainer.steps=2", "trainer.validations=1"]
PENDULUM = ROOT / "examples" / "double_pendulum.urdf"
KNOWN = ["dataset=csv_log", "dataset.root={folder}", "dataset.files=arm.csv", *LOG[1:]]
KNOWN += ["dataset.q.columns=[q1,q2]", "dataset.q.unit=rad", "dataset.u.columns=[u1,u2]"]
for part in ("validation", "test"):
    KNOWN += [f"+dataset.{part}.seconds=2.0", f"dataset.{part}.piece=1.0"]
KNOWN += ["model=known", "model/structure=urdf", f"model.structure.urdf={PENDULUM}"]
SHORT = ["steps=2", "duration=3"]
COMMANDS = {
    "no momenta": ["train.py", *LOG, "model=hnn"],
    "midpoint, no derivative": ["train.py", *TINY, "model=mlp", "loss=midpoint"],
    "midpoint, several steps": ["train.py", *TINY, "model=lnn", "loss=midpoint", "data.steps=2"],
    "midpoint, learned velocity": [
        *("train.py", *TINY, "model=lnn", "loss=midpoint", "model/initial_velocity=learned"),
    ],
    "least squares of a network": ["train.py", *TINY, "model=lnn", "optimizer=least_squares"],
    "inputs in ampere": ["train.py", *KNOWN, "dataset.u.unit=A"],
    "optimizer that mixes members": [
        *("train.py", *TINY, "model=lnn", "ensemble=2", "optimizer=soap"),
        "optimizer._target_=torch.optim.Adafactor",
    ],
    "delay of a held input": [
        *("train.py", *LOG, "model=lnn", "model/delay=learned", "data.history=0.1"),
        "dataset.interpolation=hold",
    ],
    "delay without history": [
        *("train.py", *LOG, "model=lnn", "model/delay=learned", "data.history=0.01"),
    ],
    "no compiler": ["train.py", *TINY, "model=mlp", "compile=true"],
    "option of a group": ["train.py", *TINY, "model=lnn", "model.damping=constant"],
    "chain of M^-1": ["train.py", *TINY, "model=hnn", "model.inverse_mass.transposed=true"],
    "chain, not transposed": ["train.py", *TINY, "model=lnn", "model.mass.chain=true"],
    "check of a simulation": ["check.py", "dataset=soft_arm_1"],
    "no structure": ["excite.py", *SHORT],
}
VALUES = {"model.structure.urdf=...": f"model.structure.urdf={PENDULUM}"}


def suggestions(message):
    """Return the overrides that the end of a message suggests, for each alternative."""
    *_, advice = ADVICE.split(message)
    for placeholder, value in VALUES.items():
        advice = advice.replace(placeholder, value)
    matches = [OVERRIDE.findall(part) for part in re.split(r",? or ", advice)]
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


@pytest.mark.parametrize("name", COMMANDS)
def test_the_suggested_override_works(name, tmp_path, monkeypatch):
    if name == "no compiler":
        monkeypatch.setattr("pinn_dyn.app.trainer.has_cpp_compiler", lambda: False)
    arm = log("arm", 0, 0.05)
    table = {"t": arm.t, "q1": arm.q[:, 0], "q2": arm.q[:, 1], "u1": arm.u[:, 0], "u2": arm.u[:, 1]}
    pd.DataFrame(table).to_csv(tmp_path / "arm.csv", index=False)
    script, *words = [word.replace("{folder}", str(tmp_path)) for word in COMMANDS[name]]
    if script == "train.py":
        words.append(NO_FIGURES)
    message = str(fails(script, *words, f"hydra.run.dir={tmp_path / 'refused'}").code)
    choices = suggestions(message)
    assert choices, message
    for k, overrides in enumerate(choices):
        folder = tmp_path / str(k)
        run_script(script, *applied(words, overrides), f"hydra.run.dir={folder}")
        assert (folder / "config.yaml").is_file()
