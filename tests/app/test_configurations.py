"""Every experiment, every model and every head composes and trains through the entry point."""

import json

import pytest
from hydra._internal.config_repository import ConfigRepository as Hydra

from pinn_dyn.app.config import CONF, composed
from pinn_dyn.app.control import build_reference
from pinn_dyn.systems import TendonArm
from tests.app.entry import (
    NO_FIGURES,
    ROOT,
    RUNS,
    STRIDE,
    TINY_DATA,
    TINY_TRAINING,
    assert_trained,
    run_script,
    train,
)
from tests.support.contracts import slow_except
from tests.support.processes import fork
from tests.support.recorded_logs import LOGS

# Known mechanics need a rigid robot: the experiments on logs train them, with every structure, and
# tests/models/test_drive_limits.py fits their limits and losses.
RIGID = ("known", "known_and_network")
MODELS = sorted(path.stem for path in (CONF / "model").glob("*.yaml") if path.stem not in RIGID)
LOSSES = sorted(path.stem for path in (CONF / "loss").glob("*.yaml"))
EXPERIMENTS = sorted(
    str(path.relative_to(CONF / "experiment").with_suffix(""))
    for path in (CONF / "experiment").rglob("*.yaml")
)
LOG_EXPERIMENTS = ("double_pendulum", "known", "soft_neck", "trunk", "ur10e")
HEADS = {
    folder.name: sorted(path.stem for path in folder.glob("*.yaml") if path.stem != "load")
    for folder in sorted((CONF / "model").iterdir())
    if folder.is_dir() and folder.name not in ("structure", "limits")
}
# Configurations that leave a value to the user.
VALUES = {
    "model/potential=chain": "model.angles=[0,1,2]",
}


def of_arm_1(folder):
    return [*TINY_DATA, STRIDE]


def of_arm_1_wide(folder):
    return [*of_arm_1(folder), "data.steps=1"]  # windows of 20 steps are longer than the motions


def of_short_windows(folder):
    return [*of_arm_1(folder), "data.steps=5"]


def of_arm_2(folder):
    short = ["dataset.test_duration=0.2", "dataset.keep_every=1", "dataset.compile=false"]
    return [*TINY_DATA, STRIDE, *short]


def of_tendons(folder):
    coarse = ["dataset.rtol=0.001", "dataset.atol=0.0001"]  # tendons are stiff
    return [*of_arm_1(folder), *coarse, "optimizer.cutoff=20"]


def of_panda(folder):
    pytest.importorskip("pybullet", reason="the Panda is simulated by PyBullet: pinn_dyn[panda]")
    counts = ["dataset.train=2", "dataset.validation=1", "dataset.test=1"]
    return ["dataset.duration=0.2", *counts, STRIDE]


def of_logs(folder):
    return []


def of_emps(folder):
    return ["dataset=emps", f"model.structure.urdf={ROOT / 'examples' / 'emps.urdf'}"]


# How to make the data set that an experiment is named after small, or to write a stand-in for it.
DATA = {
    "soft_arm_1": of_arm_1,
    "soft_arm_1_wide": of_arm_1_wide,
    "soft_arm_2": of_arm_2,
    "oscillators": of_short_windows,
    "soft_arm_tendon": of_tendons,
    "panda": of_panda,
    "demo": of_arm_1,
    "example_log": of_logs,
    "known": of_emps,
    "double_pendulum": of_logs,
    "soft_neck": of_logs,
    "trunk": of_logs,
    "ur10e": of_logs,
}


# A least-squares fit counts as one step and would go on until it converges.
FITTED = ("known", "soft_arm_tendon", "ur10e")
SHORT_FIT = ["optimizer.evaluations=2", "optimizer.samples=200", "data.steps=2"]


# Of the others the data, the model and the heads are those of these, or of the runs below.
FAST = ("example_log", "panda", "soft_arm_tendon")


@pytest.mark.parametrize("experiment", slow_except(EXPERIMENTS, FAST))
def test_every_experiment_trains(tmp_path, monkeypatch, experiment):
    if experiment in LOG_EXPERIMENTS and not LOGS.is_dir():
        pytest.skip("no recorded logs")
    monkeypatch.setenv("PINN_DYN_LOGS", str(LOGS))
    monkeypatch.chdir(ROOT)  # from where the example log is found
    folder = tmp_path / "run"
    run_script(
        "train.py",
        f"experiment={experiment}",
        *TINY_TRAINING,
        *DATA[experiment](tmp_path),
        *(SHORT_FIT if experiment in FITTED else ()),
        NO_FIGURES,
        "compile=false",
        f"hydra.run.dir={folder}",
    )
    assert_trained(folder, steps=1 if experiment in FITTED else 2)


def test_taut_tendons_hold_the_set_points_of_their_experiment():
    config = composed("control", ["experiment=soft_arm_tendon/regulation", "run=any"])
    arm = TendonArm()
    q = build_reference(config, arm)(0.0).q
    u = arm.input_for(q, 0 * q, 0 * q)
    assert q.shape == (24, 3)
    assert arm.tensions(q, u).min() > 1.0
    a = arm.forward_dynamics(q, 0 * q, u)
    assert a.abs().max() < 1e-2


# tests/app/test_training.py trains an acceleration network, into the default folder.
@pytest.mark.parametrize("model", [x for x in MODELS if x not in ("hnn", "acceleration")])
def test_every_other_model_trains(tmp_path, run_of, model):
    run = run_of(model) if model in RUNS else train(tmp_path / "run", f"model={model}", NO_FIGURES)
    assert_trained(run)


TOGETHER = [
    [f"model/{group}={found[number % len(found)]}" for group, found in HEADS.items()]
    for number in range(max(map(len, HEADS.values())))
]


@pytest.mark.parametrize("heads", TOGETHER, ids=" ".join)
def test_every_head_trains(tmp_path, heads):
    """The first option of every group together, then the second, and so on."""
    values = [VALUES[head] for head in heads if head in VALUES]
    assert_trained(train(tmp_path / "run", "model=lnn", *heads, *values, NO_FIGURES))


@pytest.mark.parametrize("option", slow_except(HEADS["mass"], ["network"]))
def test_every_mass_head_trains_as_an_inverse_mass(tmp_path, option):
    value = ["model.inverse_mass.value=[[100,0,0],[0,100,0],[0,0,10]]"]
    folder = train(
        tmp_path / "run",
        "model=hnn",
        f"model/mass@model.inverse_mass={option}",
        *(value if option == "fixed" else []),
        NO_FIGURES,
    )
    assert_trained(folder)


@pytest.mark.parametrize("model", ["lnn", "hnn"])
def test_the_other_loss_trains(tmp_path, model):
    assert LOSSES == ["increment", "midpoint"]
    assert_trained(train(tmp_path / "run", "loss=midpoint", f"model={model}", NO_FIGURES))


def test_a_curriculum_trains(tmp_path):
    several = ["data.steps=4", "loss.curriculum=[1,2,4]", "trainer.steps=6"]
    folder = train(tmp_path / "run", "model=lnn", *several, NO_FIGURES)
    assert_trained(folder, steps=6)


def test_what_the_tests_compose_faster_is_what_hydra_composes(tmp_path, kept_compositions):
    """:mod:`tests.support.compositions` replaces parts of Hydra; a copy of this process has all."""
    choices = [
        ["experiment=ur10e", "optimizer.rollouts=false", "~callbacks.figures"],
        ["model=hnn", "model.integrator.substeps=2"],
    ]
    choices = [[*words, "model_name=any"] for words in choices]
    found = tmp_path / "found.json"

    def work():
        kept_compositions.undo()
        assert Hydra.load_config is not faster
        found.write_text(json.dumps([composed("train", words) for words in choices]))

    faster, log = Hydra.load_config, tmp_path / "log.txt"
    with log.open("w") as output:
        process = fork(work, output)
        process.join(60)
        process.kill()  # if it has not ended
    assert process.exitcode == 0, log.read_text()
    assert json.loads(found.read_text()) == [composed("train", words) for words in choices]
