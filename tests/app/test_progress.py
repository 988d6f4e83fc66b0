"""Lines of progress: every ten seconds, in the log or on stderr, whatever takes the time."""

import logging
import time

import pandas as pd
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import pinn_dyn
from pinn_dyn.progress import Progress
from tests.app.entry import NO_FIGURES, ROOT, train


@pytest.fixture
def quick(monkeypatch):
    """A line every 20 ms instead of every ten seconds."""
    monkeypatch.setattr("pinn_dyn.progress.FIRST", 0.02)
    monkeypatch.setattr("pinn_dyn.progress.INTERVAL", 0.02)


def test_lines_arrive_without_updates_and_end_with_the_task(quick, caplog):
    caplog.set_level(logging.INFO)
    with Progress("work", 10, "parts") as progress:
        progress.update(1)
        time.sleep(0.1)
        progress.update(5, ", loss 0.5")
        time.sleep(0.1)
    lines = [record.getMessage() for record in caplog.records]
    assert lines[0] == "work: 1 of 10 parts"
    assert lines[-1].startswith("work: 5 of 10 parts, loss 0.5, ")
    assert lines[-1].endswith("s left")
    time.sleep(0.05)
    assert len(caplog.records) == len(lines)


def test_the_remaining_time_excludes_what_came_before_the_first_step(monkeypatch):
    monkeypatch.setattr("time.monotonic", iter([100.0, 110.0, 110.0]).__next__)
    progress = Progress("work", 500, "steps")
    progress.update(100)  # after a compilation, or resumed
    progress.update(200)
    assert str(progress) == "work: 200 of 500 steps, 30 s left"


def test_a_training_and_its_evaluation_log_their_progress(quick, tmp_path, capsys, caplog):
    run = train(
        tmp_path / "run",
        *("model=lnn", "trainer.steps=100", "trainer.enable_progress_bar=true", NO_FIGURES),
    )
    text = (run / "train.log").read_text()
    shown = capsys.readouterr().out
    for part in ("training soft_arm_1/lnn seed 0: ", " of 100 steps, loss ", " s left"):
        assert part in text
        assert part in shown
    losses = EventAccumulator(str(run / "tensorboard")).Reload().Scalars("train/loss")
    assert [item.step for item in losses] == list(range(1, 100, 2))
    assert len({item.value for item in losses}) == 50
    caplog.set_level(logging.INFO)
    pinn_dyn.evaluate(pinn_dyn.load(run), horizon=0.1, windows=[])
    assert "evaluation: 0 of 5 models, now " in caplog.text


def test_a_program_without_handlers_gets_the_lines_on_stderr(quick, monkeypatch, capsys):
    monkeypatch.setattr(logging.Logger, "hasHandlers", lambda _: False)
    log = pd.read_csv(ROOT / "examples" / "example_log.csv")
    pinn_dyn.fit(
        log[log.run.isin(log.run.unique()[:5])],
        q={"columns": ["bend_x", "bend_y", "stretch"], "unit": ["deg", "deg", "mm"]},
        u={"columns": ["torque_x", "torque_y", "force"], "unit": ["Nm", "Nm", "N"]},
        run="run",
        steps=8,
        validations=1,
        compile=False,
    )
    assert "training frame/lnn seed 0: " in capsys.readouterr().err
