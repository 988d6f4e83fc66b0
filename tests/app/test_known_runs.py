"""Runs of known mechanics that others start from: a network on top, or the robot with a load."""

import json
import os
import re
import shutil
import signal
import time

import numpy as np
import pandas as pd
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

import pinn_dyn
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares
from tests.app.entry import NO_FIGURES, fork_script, refused_text, run_script
from tests.support.recorded_logs import LOGS, ROOT, needs_logs

pytestmark = needs_logs
WINDOWS_OF_PENDULUM = ["dataset=double_pendulum", "data=multi_step", "validator.horizon=1"]
URDF = f"structure.urdf={ROOT / 'examples' / 'double_pendulum.urdf'}"
KNOWN = [
    *WINDOWS_OF_PENDULUM,
    *("model=known", "model/friction=stribeck", f"model.{URDF}", "model.start=prior"),
    *("optimizer=least_squares", "data.pairs=150", "data.batch_size=150", "data.stride=10"),
]
WINDOWS = ["data.pairs=20", "data.batch_size=20", "data.steps=2", "validator.horizon=0.1"]
WINDOWS += [NO_FIGURES]
SMALL = [*WINDOWS, "optimizer.rollouts=false"]


@pytest.fixture(scope="module", autouse=True)
def quick():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PINN_DYN_LOGS", str(LOGS))
        yield


@pytest.fixture(scope="module")
def fitted(tmp_path_factory, quick):
    folder = tmp_path_factory.mktemp("runs") / "known"
    arm = folder.parent / "arm.urdf"
    text = (ROOT / "examples" / "double_pendulum.urdf").read_text()
    arm.write_text(text)
    words = [*KNOWN, f"model.structure.urdf={arm}", *SMALL]
    run_script("train.py", *words, f"hydra.run.dir={folder}")
    arm.write_text(text.replace("0 0 -0.2", "0 0 -0.3"))  # after the training
    return folder


def test_a_run_contains_its_structure(fitted, capsys):
    arm = fitted.parent / "arm.urdf"
    q, v = torch.randn(2, 5, 2, generator=torch.manual_seed(0)).double()
    structure = pinn_dyn.load(fitted).system.structure
    trained, edited = (RigidChain(x) for x in (f"{ROOT}/examples/double_pendulum.urdf", str(arm)))
    expected = trained.rigid_force(q, v, v)
    assert not torch.allclose(edited.rigid_force(q, v, v), expected, rtol=0.1)
    torch.testing.assert_close(structure.rigid_force(q, v, v), expected, rtol=1e-6, atol=1e-6)
    words = [*KNOWN, f"model.structure.urdf={arm}", *SMALL, f"hydra.run.dir={fitted}"]
    text = " ".join(refused_text(capsys, "train.py", *words).split())
    assert re.search(r"another configuration: model.structure.urdf=\S+arm.urdf \w{8} \(there", text)


def test_the_errors_and_settings_of_a_fit_are_logged(fitted):
    record = json.loads((fitted / "metrics.json").read_text())
    log = EventAccumulator(str(fitted / "tensorboard")).Reload()
    for name in ("val/error_mean", "val/error_windowed", "train/loss"):
        (scalar,) = log.Scalars(name)
        assert (scalar.step, scalar.value) == (0, pytest.approx(record["validation"][name]))
    content = log.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    start = HParamsPluginData.FromString(content).session_start_info
    assert start.hparams["model_name"].string_value == "known"
    assert start.hparams["data.pairs"].number_value == 20


def test_what_the_motions_leave_open_is_counted(fitted):
    text = (fitted / "undetermined.md").read_text()
    assert text.startswith("0 of 13 base parameters are not determined by the motions.\n")
    assert "- " not in text


def test_constants_have_units_and_the_names_of_joints(fitted):
    table = pd.read_csv(fitted / "constants.csv").set_index("name")
    assert table.unit["armature of shoulder"] == "kg m^2"
    assert table.unit["Coulomb friction (v > 0) of elbow"] == "Nm"
    assert table.unit["friction width of elbow"] == "rad/s"
    assert not table.unit.isin(["SI"]).any()
    assert not table.index.str.contains("joint ").any()
    positive = ~table.index.str.match("m c|I(xy|xz|yz)|torque offset")
    assert (table.low[positive] >= 0).all()


def constants(folder):
    saved = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
    return {key: value for key, value in saved.items() if key.endswith(".z")}


def test_a_network_starts_on_the_constants_of_a_fit(tmp_path, fitted):
    folder = tmp_path / "both"
    run_script(
        "train.py",
        *WINDOWS_OF_PENDULUM,
        *("model=known_and_network", "model/friction@model.known.friction=stribeck"),
        *(f"model.known.{URDF}", "model.known.start=prior", "data.stride=5", "data.pairs=10000"),
        *WINDOWS,
        f"start_from={fitted}",
        "optimizer.lr=1e-9",
        "trainer.steps=1",
        "trainer.validations=1",
        "compile=false",
        f"hydra.run.dir={folder}",
    )
    found = constants(folder)
    for key, value in constants(fitted).items():
        assert value.abs().max() > 0.01
        name = key.replace("model.", "model.parts.known.", 1)
        assert torch.allclose(found[name], value, atol=1e-6)


def test_a_fit_that_starts_from_another_keeps_what_it_found(tmp_path, fitted):
    folder = tmp_path / "again"
    short = ["optimizer.samples=40", f"start_from={fitted}"]
    run_script("train.py", *KNOWN, *SMALL, *short, f"hydra.run.dir={folder}")
    before, after = constants(fitted), constants(folder)
    apart = max(float((after[key] - before[key]).abs().max()) for key in before)
    alone = tmp_path / "alone"
    run_script("train.py", *KNOWN, *SMALL, short[0], f"hydra.run.dir={alone}")
    else_where = constants(alone)
    assert apart < 0.5 * max(float((else_where[k] - before[k]).abs().max()) for k in before)


@pytest.mark.usefixtures("undrawn")
def test_a_fit_has_intervals_of_its_predictions(tmp_path, fitted):
    run_script(
        "evaluate.py",
        f"runs=[{fitted}]",
        "windows=[0.1]",
        "horizon=0.5",
        f"hydra.run.dir={tmp_path}",
    )
    table = pd.read_csv(tmp_path / "summary.csv")
    (row,) = table[~table.baseline].to_dict("records")
    assert pd.read_csv(tmp_path / "ensembles.csv")["members"].tolist() == [20]
    assert 0.5 < row["window_0.1s_within"] <= 1
    assert row["window_0.1s_factor"] > 0
    model = pinn_dyn.load(fitted)
    t = np.linspace(0, 0.2, 11)
    start, u = np.array([0.5, -0.5, 1.0, -1.0]), np.zeros((11, 2))
    low, high = model.predict_interval(start, u, t)
    middle = model.predict(start, u, t)
    assert (low[1:] < middle[1:]).all()
    assert (middle[1:] < high[1:]).all()


@pytest.mark.usefixtures("undrawn")
def test_a_fit_with_rollouts_has_its_identification_beside_it(tmp_path):
    words = ["model/friction=coulomb", "data.steps=5", "validator.horizon=0.5"]
    words += ["optimizer.samples=500", "optimizer.evaluations=8"]
    for name, stages in {"rolled": [], "alone": ["optimizer.rollouts=false"]}.items():
        run_script(
            "train.py", *KNOWN, *WINDOWS, *words, *stages, f"hydra.run.dir={tmp_path / name}"
        )
    assert json.loads((tmp_path / "rolled" / "metrics.json").read_text())["stage"][:8] == "rollouts"
    table = pd.read_csv(tmp_path / "rolled" / "constants.csv")
    assert table.name.str.match(r"Coulomb friction.* of (shoulder|elbow)").sum() == 2
    folders = ",".join(str(tmp_path / name) for name in ("rolled", "alone"))
    words = ["windows=[0.1]", "horizon=0.2", f"hydra.run.dir={tmp_path / 'both'}"]
    run_script("evaluate.py", f"runs=[{folders}]", *words)
    summary = pd.read_csv(tmp_path / "both" / "summary.csv")
    rolled, alone = summary[~summary["baseline"]].to_dict("records")
    (identified,) = summary[summary["run"].str.startswith("identification")].to_dict("records")
    for column in ("error_mean", "error_worst", "window_0.1s_error_mean", "torque_share"):
        assert identified[column] == pytest.approx(alone[column], rel=1e-5)
    assert identified["baseline"]
    assert identified["error_mean"] != rolled["error_mean"]


FORGED = {
    "none": (lambda c: None, "has no covariance of its constants"),
    "of another": (lambda c: c[:3, :3], "the earlier fit has 3 constants, this model"),
}


def test_a_covariance_that_is_none_is_no_prior(tmp_path, fitted, capsys):
    forged = shutil.copytree(fitted, tmp_path / "forged")
    path = forged / "checkpoints" / "best.ckpt"
    whole = torch.load(path, weights_only=True)
    for change, message in FORGED.values():
        torch.save({**whole, "covariance": change(whole["covariance"])}, path)
        start = [f"start_from={forged}", f"hydra.run.dir={tmp_path / 'no'}"]
        text = refused_text(capsys, "train.py", *KNOWN, *SMALL, *start)
        assert re.search(message, text, re.DOTALL)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["optimizer.changed=[hand]"], "changed is .'hand'., but there is no earlier fit"),
        (["optimizer.cutoff=400"], "cutoff is 400.* less than half the sample rate"),
        (["dataset.u.unit=A"], "tau_cmd1 in A, tau_cmd2 in A, no forces"),
        (["data.pairs=1", "data.batch_size=1"], r"1 windows of 2 steps give 8 residuals for \d+"),
    ],
)
def test_a_fit_that_the_data_refuse_ends_in_a_sentence(tmp_path, capsys, words, message):
    small = SMALL if message[0] != "1" else [*WINDOWS]
    arguments = [*KNOWN, *small, *words, f"hydra.run.dir={tmp_path / 'no'}"]
    assert re.search(message, refused_text(capsys, "train.py", *arguments))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_stopped_fit_ends_at_once_and_goes_on(tmp_path, monkeypatch, number):
    folder, begun, log = tmp_path / "run", tmp_path / "begun", tmp_path / "log.txt"

    def endless(*_):
        begun.touch()
        time.sleep(600)

    with log.open("w") as output, monkeypatch.context() as patch:
        patch.setattr("pinn_dyn.training.sensitivity.WindowRollouts.increments", endless)
        short = ["optimizer.samples=200", "optimizer.evaluations=5"]
        words = [*KNOWN, *WINDOWS, *short, f"hydra.run.dir={folder}"]
        process = fork_script("train.py", *words, folder=tmp_path, output=output)
        try:
            while not begun.exists() and process.is_alive():
                time.sleep(0.05)
            os.kill(process.pid, number)
            process.join(60)
        finally:
            process.kill()
    text = log.read_text()
    if number == signal.SIGTERM:
        assert process.exitcode == 128 + signal.SIGTERM, text
        assert f"train.py resume={folder}" in text
    assert not (folder / "constants.csv").exists()
    assert not (folder / "metrics.json").exists()
    kept = constants(folder)
    assert max(float(value.abs().max()) for value in kept.values()) > 0.1
    monkeypatch.setattr(LeastSquares, "_identify", lambda *_: pytest.fail("identified again"))
    run_script("train.py", f"resume={folder}")
    assert (folder / "constants.csv").exists()
    assert (folder / "metrics.json").exists()
    assert (folder / "undetermined.md").exists()


def unfinish(folder, **values):
    """Take back the end of a training, as if it was killed before its record."""
    path = folder / "checkpoints" / "last.ckpt"
    torch.save({**torch.load(path, weights_only=True), "finished": False, **values}, path)


def test_a_fit_that_is_finished_is_not_done_again(tmp_path, fitted, monkeypatch):
    """As where a training was killed after its checkpoint, and before it wrote its record."""
    folder = shutil.copytree(fitted, tmp_path / "run")
    for name in ("metrics.json", "constants.csv", "undetermined.md"):
        (folder / name).unlink()
    unfinish(folder)
    monkeypatch.setattr("pinn_dyn.training.LeastSquares.fit", lambda *_: pytest.fail("fitted"))
    run_script("train.py", f"resume={folder}")
    first, again = (pd.read_csv(place / "constants.csv") for place in (fitted, folder))
    pd.testing.assert_frame_equal(first, again, rtol=1e-6)
    assert (folder / "metrics.json").exists()
