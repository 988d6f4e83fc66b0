"""A training that goes on from a damaged, foreign or hostile checkpoint, or is asked to."""

import os
import shutil
from pickle import UnpicklingError

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pinn_dyn.app import train as training
from tests.app.entry import NO_FIGURES, refused_text, run_script, train


class Marker:
    """A pickle that makes a folder when it is read as code."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.fixture
def run(tmp_path, monkeypatch, hnn_run):
    """A run of four steps and two validations that was interrupted after its last checkpoint."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(hnn_run, tmp_path / "run")
    (tmp_path / "run" / "metrics.json").unlink()
    return tmp_path / "run"


def change(run, name="last", **values):
    path = run / "checkpoints" / f"{name}.ckpt"
    saved = torch.load(path, weights_only=True)
    torch.save({key: x for key, x in {**saved, **values}.items() if x is not None}, path)


def cut(run, name="last"):
    path = run / "checkpoints" / f"{name}.ckpt"
    path.write_bytes(path.read_bytes()[:1000])


def refused(capsys, run, *words):
    return refused_text(capsys, "train.py", f"resume={run}", *words)


def test_a_pickle_that_runs_code_is_refused(run, tmp_path, capsys):
    change(run, payload=Marker(tmp_path / "was_here"))
    text = refused(capsys, run)
    assert "last.ckpt cannot be read" in text
    assert "resume_from=best" in text
    assert not (tmp_path / "was_here").exists()


def test_the_trainer_itself_reads_no_code(run, tmp_path, monkeypatch):
    """Behind the check of the file, which is taken away here."""
    change(run, payload=Marker(tmp_path / "was_here"))
    monkeypatch.setattr(training, "_whole", lambda folder, checkpoint, trust: checkpoint)
    with pytest.raises(UnpicklingError, match="Weights only load failed"):
        run_script("train.py", f"resume={run}")
    assert not (tmp_path / "was_here").exists()


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (cut, "last.ckpt cannot be read, it may be cut short"),
        (lambda run: change(run, optimizer_states=None), "has no optimizer_states"),
        (lambda run: change(run, loops=None), "has no loops"),
        (lambda run: change(run, state_dict=None), "is no checkpoint that train.py wrote"),
    ],
)
def test_a_damaged_last_checkpoint_offers_the_best_one(run, capsys, damage, expected):
    damage(run)
    text = refused(capsys, run)
    assert expected in text
    assert f"python train.py resume={run} resume_from=best" in text


def test_the_training_goes_on_from_the_best_one(tmp_path, capsys):
    """One that diverges, so that the best is an early one."""
    length = ["trainer.steps=30", "trainer.validations=6", "optimizer.lr=0.5"]
    run = train(tmp_path / "run", "model=lnn", *length, NO_FIGURES)
    (run / "metrics.json").unlink()
    cut(run)
    step = torch.load(run / "checkpoints" / "best.ckpt", weights_only=True)["global_step"]
    assert step < 30
    before = set(run.rglob("events.out.tfevents.*"))
    run_script("train.py", f"resume={run}", "resume_from=best")
    assert f"going on with the training in {run} from step {step}" in capsys.readouterr().out
    assert (run / "metrics.json").is_file()
    last = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    assert last["global_step"] == 30
    (log,) = set(run.rglob("events.out.tfevents.*")) - before
    events = EventAccumulator(str(log)).Reload().Scalars("val/error_mean")
    assert [event.step for event in events] == list(range(step + 4, 30, 5))


def test_where_both_are_damaged_it_says_so(run, capsys):
    cut(run)
    cut(run, "best")
    text = refused(capsys, run)
    assert "last.ckpt cannot be read" in text
    assert "best.ckpt is no better: delete" in text


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["resume={run}", "resume_from=first"], "resume_from is 'first', expected last or best"),
        (["resume={run}", "seed=1"], "leave out seed=1"),
        (["resume_from=best"], "resume_from says from which checkpoint: give resume=<run>"),
        (["resume=nowhere"], "nowhere is not a run folder"),
    ],
)
def test_what_resume_cannot_use_is_refused(run, capsys, words, expected):
    said = refused_text(capsys, "train.py", *(word.format(run=run) for word in words))
    assert expected in " ".join(said.split())
