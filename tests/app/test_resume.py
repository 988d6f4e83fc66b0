"""Interrupted trainings: checkpoints are whole, and a resumed training is an uninterrupted one."""

import os
import shlex
import shutil
import signal
import time
from functools import partial

import lightning as L
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import pinn_dyn
from pinn_dyn.app.sweep import resume_command
from pinn_dyn.data import DynamicsData
from pinn_dyn.evaluation import RolloutValidator
from tests.app.entry import (
    NO_FIGURES,
    TINY,
    TINY_DATA,
    fork_script,
    refused_text,
    run_script,
    train,
)


class Interrupt(L.Callback):
    """Ctrl-C in an epoch."""

    def __init__(self, epoch):
        self.epoch = epoch

    def on_train_epoch_start(self, trainer, pl_module):
        if trainer.current_epoch == self.epoch:
            raise KeyboardInterrupt


class Marker:
    """A pickle that makes a folder when it is read as code."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def trained(folder, *callbacks):
    """A training of six steps and three validations in Python."""
    source = pinn_dyn.dataset("soft_arm_1", **dict(word[8:].split("=") for word in TINY_DATA))
    return pinn_dyn.train(
        source,
        "lnn",
        data=partial(DynamicsData, pairs=64, batch_size=32, stride=5),
        validator=partial(RolloutValidator, horizon=0.1),
        steps=6,
        validations=3,
        folder=folder,
        callbacks=callbacks,
    )


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """A training that was interrupted after its second validation."""
    folder = tmp_path_factory.mktemp("interrupted") / "run"
    with pytest.raises(KeyboardInterrupt):
        trained(folder, Interrupt(epoch=2))
    return folder


@pytest.fixture
def run(tmp_path, monkeypatch, interrupted):
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(interrupted, tmp_path / "run")


def checkpoint(run, name="last"):
    return torch.load(run / "checkpoints" / f"{name}.ckpt", weights_only=True)


def change(run, name="last", **values):
    saved = {**checkpoint(run, name), **values}
    kept = {key: value for key, value in saved.items() if value is not None}
    torch.save(kept, run / "checkpoints" / f"{name}.ckpt")


def cut(run, name="last"):
    path = run / "checkpoints" / f"{name}.ckpt"
    path.write_bytes(path.read_bytes()[:1000])


def test_a_resumed_training_equals_an_uninterrupted_one(run, tmp_path):
    assert not pinn_dyn.load(run).finished
    assert not (run / "metrics.json").exists()
    record = checkpoint(run)["record"]
    record["training_seconds"] += 1000  # a long first part
    change(run, record=record)
    resumed, whole = trained(run), trained(tmp_path / "whole")
    assert resumed.finished
    assert 1000 < resumed.metrics["training_seconds"] < 1600
    for name in ("best", "last"):
        first, second = (checkpoint(folder, name) for folder in (run, tmp_path / "whole"))
        assert first["global_step"] == second["global_step"]
        for key, value in first["state_dict"].items():
            assert torch.equal(value, second["state_dict"][key]), key
    for name in ("val/error_mean", "val/error_windowed", "train/loss"):
        assert resumed.metrics["last_validation"][name] == whole.metrics["last_validation"][name]
    for name in ("validation", "kept_step"):
        assert resumed.metrics[name] == whole.metrics[name]


def test_a_finished_training_is_not_repeated(run, monkeypatch):
    finished = trained(run)
    monkeypatch.setattr(
        "pinn_dyn.run.training.prepared.build_data", lambda *_: pytest.fail("trained again")
    )
    assert trained(run).metrics == finished.metrics
    (run / "metrics.json").unlink()  # a copy
    assert trained(run).metrics == finished.metrics


def test_a_moved_training_keeps_its_best_score(run, tmp_path):
    run = run.rename(tmp_path / "moved")
    key = next(k for k in checkpoint(run)["callbacks"] if "'monitor': 'val/error_w" in k)
    saved = checkpoint(run)
    state = saved["callbacks"][key]
    saved["callbacks"][key] = {**state, "best_model_score": torch.tensor(0.0), "kth_value": 0.0}
    saved["callbacks"][key]["best_k_models"] = {state["best_model_path"]: torch.tensor(0.0)}
    change(run, callbacks=saved["callbacks"])
    best = checkpoint(run, "best")["global_step"]
    trained(run)
    assert checkpoint(run, "best")["global_step"] == best  # no later score is better than zero


def test_a_terminated_training_ends_with_a_status_and_can_be_resumed(tmp_path):
    folder, log = tmp_path / "run", tmp_path / "log.txt"
    last = folder / "checkpoints" / "last.ckpt"
    with log.open("w") as output:
        length = ["trainer.steps=50000", "trainer.validations=1000", "compile=false", "model=lnn"]
        words = [*TINY, *length, NO_FIGURES, f"hydra.run.dir={folder}"]
        process = fork_script("train.py", *words, folder=tmp_path, output=output)
        try:
            while not last.is_file() and process.is_alive():
                time.sleep(0.05)
            process.terminate()
            process.join(120)
        finally:
            process.kill()
    assert process.exitcode == 128 + signal.SIGTERM, log.read_text()
    assert f"train.py resume={folder}" in log.read_text()
    assert torch.load(last, weights_only=True)["global_step"] > 0
    assert not list(folder.rglob("*.partial"))


# The command line.


@pytest.fixture(scope="module")
def diverging(tmp_path_factory):
    """A training whose best checkpoint is an early one."""
    folder = tmp_path_factory.mktemp("diverging") / "run"
    length = ["trainer.steps=30", "trainer.validations=6", "optimizer.lr=0.5"]
    train(folder, "model=lnn", *length, NO_FIGURES)
    for name in ("best", "last"):
        change(folder, name, finished=None)
    return folder


@pytest.fixture
def command(tmp_path, monkeypatch, diverging):
    """An unfinished run of train.py."""
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(diverging, tmp_path / "run")


@pytest.mark.parametrize("program", [["python", "train.py"], ["/opt/bin/pinn-dyn-train"]])
def test_the_printed_command_resumes_the_run(command, monkeypatch, program):
    """With a folder that a shell and Hydra would split, and the options of this program."""
    folder = command.rename(command.with_name("an arm's run, {seed=0}"))
    folder.with_name("my_conf").mkdir()
    options = [*program[1:], "--config-dir=my_conf"]
    monkeypatch.setattr("sys.argv", [program[-1], "--config-dir", "my_conf", "model=lnn"])
    words = shlex.split(resume_command(folder))
    assert words[:-1] == [program[0], *options]
    run_script("train.py", "--config-dir=my_conf", words[-1], checked=True)
    assert pinn_dyn.load(folder).finished


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (cut, "last.ckpt cannot be read, it may be cut short"),
        (lambda run: change(run, payload=Marker("was_here")), "last.ckpt cannot be read"),
    ],
)
def test_a_damaged_last_checkpoint_is_replaced_by_the_best_one(command, capsys, damage, message):
    damage(command)
    step = checkpoint(command, "best")["global_step"]
    assert step < 30
    before = set(command.rglob("events.out.tfevents.*"))
    run_script("train.py", f"resume={command}")
    text = capsys.readouterr().out
    assert message in text
    assert f"from step {step}" in text
    assert not os.path.exists("was_here")
    assert pinn_dyn.load(command).finished
    assert checkpoint(command)["global_step"] == 30
    (log,) = set(command.rglob("events.out.tfevents.*")) - before
    events = EventAccumulator(str(log)).Reload().Scalars("val/error_mean")
    assert [event.step for event in events] == list(range(step + 4, 30, 5))


def test_a_resumed_training_writes_to_its_own_folder(command, tmp_path):
    """Whatever the configuration in the checkpoint says about places and names."""
    saved = checkpoint(command)
    logger = {"_target_": "lightning.pytorch.loggers.CSVLogger", "_partial_": True}
    parts = saved["hyper_parameters"]
    parts["config"]["logger"] = {"csv": {**logger, "name": "elsewhere", "version": "x"}}
    keep = {"_target_": "lightning.pytorch.callbacks.ModelCheckpoint", "monitor": "val/error_mean"}
    parts["config"]["callbacks"] = {"keep": {**keep, "filename": "stolen"}}
    change(command, hyper_parameters=parts)
    run_script("train.py", f"resume={command}")
    assert not list((tmp_path / "runs").rglob("*elsewhere*"))
    assert list(command.rglob("metrics.csv"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["resume={run}", "seed=1"], "leave out"),
        (["resume=nowhere"], "nowhere/checkpoints/last.ckpt does not exist"),
    ],
)
def test_what_resume_cannot_use_is_named(command, capsys, words, message):
    text = refused_text(capsys, "train.py", *(word.format(run=command) for word in words))
    assert message in " ".join(text.split())


def test_resume_refuses_changed_data(command, capsys):
    data = checkpoint(command)["data"]
    data["train"]["hashes"][1] = "0" * 16
    data["train"]["moments"][1, 0, 0] += 0.1
    change(command, data=data)
    text = refused_text(capsys, "train.py", f"resume={command}")
    assert "soft_arm_1 has changed since" in text
    assert "train trajectory 1 in train has other values" in text


# Writing.
