"""A training that was killed and resumed ends with the weights of one that ran through."""

import json
import os
import signal
from functools import partial

import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pinn_dyn.training import DynamicsLearner
from tests.app.entry import NO_FIGURES, TINY, fork_script, run_script

EPOCHS, BATCHES = 5, 3
KILLED = 7  # before this step: within the third epoch, and with one step of the windows
LONG = [
    *TINY,
    NO_FIGURES,
    "model=lnn",
    "data.steps=2",
    "loss.curriculum=[1,2]",  # the second step counts from the middle of the training on
    f"trainer.steps={EPOCHS * BATCHES}",
    f"trainer.validations={EPOCHS}",
]


def killed_within(self, *arguments, prepared=DynamicsLearner._prepared_steps):
    """In the place of what a step does: one of them is never done."""
    for step, take in enumerate(prepared(self, *arguments), self.global_step):
        yield take if step != KILLED else partial(os.kill, os.getpid(), signal.SIGKILL)


def validations(log):
    """The steps of the validations in a log file of TensorBoard."""
    return [event.step for event in EventAccumulator(str(log)).Reload().Scalars("val/error_mean")]


def test_a_killed_and_resumed_training_ends_with_the_same_weights(tmp_path, monkeypatch):
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path / "cache"))
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    last = killed / "checkpoints" / "last.ckpt"
    log = tmp_path / "log.txt"
    with log.open("w") as output:
        at = dict(folder=tmp_path, output=output)
        with monkeypatch.context() as patch:
            patch.setattr(DynamicsLearner, "_prepared_steps", killed_within)
            process = fork_script("train.py", *LONG, f"hydra.run.dir={killed}", **at)
        process.join(600)
        process.kill()
        assert process.exitcode == -signal.SIGKILL, log.read_text()
        assert not (killed / "metrics.json").exists()
        cut = torch.load(last, weights_only=True)
        assert cut["global_step"] == KILLED // BATCHES * BATCHES
        took = cut["record"]
        assert 0 < took["training_seconds"] < 600
        took["training_seconds"] += 1000  # as if it had been long
        torch.save(cut, last)
        logs = set(killed.rglob("events.out.tfevents.*"))
        process = fork_script("train.py", f"resume={killed}", **at)
        try:
            run_script("train.py", *LONG, f"hydra.run.dir={whole}")
            process.join(600)
            assert process.exitcode == 0, log.read_text()
        finally:
            process.kill()
    first, second = (
        torch.load(run / "checkpoints" / "last.ckpt", weights_only=True) for run in (whole, killed)
    )
    assert first["global_step"] == second["global_step"] == EPOCHS * BATCHES
    assert first["state_dict"].keys() == second["state_dict"].keys()
    # It took up where the checkpoint was, and did the rest alone: a restart ends the same.
    step = cut["global_step"]
    assert f"from step {step}" in log.read_text()
    (resumed,) = set(killed.rglob("events.out.tfevents.*")) - logs
    assert validations(resumed) == list(range(step + BATCHES - 1, EPOCHS * BATCHES, BATCHES))
    moved = False
    for key, value in first["state_dict"].items():
        assert torch.equal(value, second["state_dict"][key]), key
        moved = moved or not torch.equal(value, cut["state_dict"][key])
    assert moved
    # What it took before is of what it took.
    assert 1000 < json.loads((killed / "metrics.json").read_text())["training_seconds"] < 1600
