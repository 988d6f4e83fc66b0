"""Progress without a terminal: a line per epoch, nothing that is drawn over."""

import re
from types import SimpleNamespace

from pinn_dyn.app.progress import EpochLines
from tests.app.entry import NO_FIGURES, train

LENGTH = ["trainer.steps=6", "trainer.validations=3", "trainer.enable_progress_bar=true"]


def test_a_training_says_a_line_per_epoch(tmp_path, capsys):
    train(tmp_path / "run", "model=lnn", *LENGTH, NO_FIGURES)
    captured = capsys.readouterr()
    assert "\r" not in captured.out + captured.err
    lines = re.findall(r"epoch (\d) of 3, step (\d): training loss \S+, (.*)", captured.out)
    assert [(epoch, step) for epoch, step, _ in lines] == [("1", "2"), ("2", "4"), ("3", "6")]
    assert all(re.fullmatch(r"validation error \d\S*", rest) for *_, rest in lines)


def test_a_terminal_has_a_bar_instead(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    train(tmp_path / "run", "model=lnn", *LENGTH, NO_FIGURES)
    captured = capsys.readouterr()
    assert "Epoch 2: 100%" in captured.out
    assert "epoch 1 of" not in captured.out


def test_epochs_between_validations_have_lines_too(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pinn_dyn.app.trainer.LONGEST_EPOCH", 1)
    train(tmp_path / "run", "model=lnn", "trainer.steps=2", NO_FIGURES)
    lines = re.findall(r"epoch \d of 2, step \d: (.*)", capsys.readouterr().out)
    assert ["validation" in line for line in lines] == [False, True]


def test_an_epoch_without_validation_has_no_error(caplog):
    caplog.set_level("INFO")
    trainer = SimpleNamespace(
        callback_metrics={"train/loss": 0.5, "val/error_mean": 0.25},
        current_epoch=1,
        max_epochs=4,
        check_val_every_n_epoch=2,
        global_step=10,
        is_global_zero=True,
    )
    lines = EpochLines("val/error_mean")
    lines.on_train_epoch_end(trainer, None)
    trainer.current_epoch = 2
    lines.on_train_epoch_end(trainer, None)
    first, second = (record.message for record in caplog.records)
    assert first == "epoch 2 of 4, step 10: training loss 0.5, validation error 0.25"
    assert second == "epoch 3 of 4, step 10: training loss 0.5"
