"""Checkpoints that are whole or absent, and what an interrupted training ends with."""

import signal
import time

import pytest
import torch

from pinn_dyn.training import WholeCheckpoints
from tests.app.entry import NO_FIGURES, TINY, fork_script


def test_a_checkpoint_is_replaced_only_by_a_whole_one(tmp_path, monkeypatch):
    path = tmp_path / "last.ckpt"
    writer = WholeCheckpoints()
    writer.save_checkpoint({"step": 1}, path)

    def fails_midway(checkpoint, file):
        file.write(b"half of it")
        raise OSError("No space left on device")

    monkeypatch.setattr(torch, "save", fails_midway)
    with pytest.raises(OSError, match="No space left"):
        writer.save_checkpoint({"step": 2}, path)
    assert torch.load(path, weights_only=True) == {"step": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_a_checkpoint_is_moved_into_place_in_one_step(tmp_path):
    path = tmp_path / "last.ckpt"
    WholeCheckpoints().save_checkpoint({"step": 1}, path)
    before = path.stat().st_ino
    with path.open("rb") as open_before:
        WholeCheckpoints().save_checkpoint({"step": 2}, path)
        # Who has the old one open still reads it whole: the new one is another file.
        assert torch.load(open_before, weights_only=True) == {"step": 1}
    assert path.stat().st_ino != before
    assert torch.load(path, weights_only=True) == {"step": 2}


def test_nothing_is_written_to_the_folder_of_temporary_files(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.mkstemp", lambda *_, **__: pytest.fail("a temporary file"))
    WholeCheckpoints().save_checkpoint({"step": 1}, tmp_path / "new" / "last.ckpt")
    assert torch.load(tmp_path / "new" / "last.ckpt", weights_only=True) == {"step": 1}


@pytest.mark.parametrize("sweep", [False, True])
def test_a_terminated_training_ends_with_a_status_and_can_go_on(tmp_path, sweep):
    folder = tmp_path / "run"
    where = [f"hydra.run.dir={folder}"]
    if sweep:
        where = [f"hydra.sweep.dir={tmp_path}", "hydra.sweep.subdir=run", "-m"]
    log = tmp_path / "log.txt"
    last = folder / "checkpoints" / "last.ckpt"
    with log.open("w") as output:
        length = ["trainer.steps=50000", "trainer.validations=1000", "compile=false", "model=lnn"]
        words = [*TINY, *length, NO_FIGURES, *where]
        process = fork_script("train.py", *words, folder=tmp_path, output=output)
        try:
            while not last.is_file() and process.is_alive():
                time.sleep(0.05)
            process.terminate()
            process.join(120)
        finally:
            process.kill()
    assert process.exitcode == 128 + signal.SIGTERM, log.read_text()
    text = log.read_text()
    assert f"train.py resume={folder}" in text or (sweep and "the sweep is not finished" in text)
    assert torch.load(last, weights_only=True)["global_step"] > 0
    assert not list(folder.rglob("*.partial"))
