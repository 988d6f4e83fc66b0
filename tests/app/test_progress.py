"""Progress without a terminal: a line per epoch, nothing that is drawn over."""

import re

from tests.app.entry import NO_FIGURES, train

LENGTH = ["trainer.steps=6", "trainer.validations=3", "trainer.enable_progress_bar=true"]


def test_a_training_says_a_line_per_epoch(tmp_path, capsys):
    train(tmp_path / "run", "model=lnn", *LENGTH, NO_FIGURES)
    captured = capsys.readouterr()
    assert "\r" not in captured.out + captured.err
    lines = re.findall(r"epoch (\d) of 3, step (\d): training loss \S+, (.*)", captured.out)
    assert [(epoch, step) for epoch, step, _ in lines] == [("1", "2"), ("2", "4"), ("3", "6")]
    assert all(re.fullmatch(r"validation error \d\S*", rest) for *_, rest in lines)


def test_epochs_between_validations_have_lines_too(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pinn_dyn.app.trainer.LONGEST_EPOCH", 1)
    train(tmp_path / "run", "model=lnn", "trainer.steps=2", NO_FIGURES)
    lines = re.findall(r"epoch \d of 2, step \d: (.*)", capsys.readouterr().out)
    assert ["validation" in line for line in lines] == [False, True]
