"""Trainings that go on in a run folder of others: nothing outside of the folder is written."""

import shutil

import pytest
import torch

from pinn_dyn.run.configuration.validation import ConfigError
from tests.app.entry import refused_text, run_script
from tests.support.foreign_runs import foreign

LOGGERS = "lightning.pytorch.loggers"
BOARD = {"_target_": f"{LOGGERS}.TensorBoardLogger", "_partial_": True}
CSV = {"_target_": f"{LOGGERS}.CSVLogger", "_partial_": True}
KEEPER = {"_target_": "lightning.pytorch.callbacks.ModelCheckpoint"}


def unfinished(run):
    """Take back the end of a training."""
    for path in (run / "checkpoints").iterdir():
        torch.save({**torch.load(path, weights_only=True), "finished": False}, path)
    return run


def files(folder):
    return {path: path.stat().st_mtime_ns for path in [folder, *folder.rglob("*")]}


@pytest.mark.parametrize("name", ["checkpoints", "tensorboard", "mine", "checkpoints/last.ckpt"])
def test_nothing_is_written_through_a_link(tmp_path, lnn_run, capsys, name):
    run = unfinished(shutil.copytree(lnn_run, tmp_path / "run"))
    elsewhere = tmp_path / "elsewhere"
    if (run / name).exists():
        (run / name).rename(elsewhere)
    else:
        elsewhere.mkdir()
    (run / name).symlink_to(elsewhere)
    before = files(elsewhere)
    text = refused_text(capsys, "train.py", f"resume={run}", f"hydra.run.dir={tmp_path / 'hydra'}")
    assert "is a link to" in " ".join(text.split())
    assert files(elsewhere) == before


def test_links_above_and_inside_a_run_folder_are_no_obstacle(tmp_path, lnn_run):
    run = unfinished(shutil.copytree(lnn_run, tmp_path / "disk" / "run"))
    (run / "latest.ckpt").symlink_to("checkpoints/last.ckpt")
    (tmp_path / "runs").symlink_to(tmp_path / "disk")
    run_script("train.py", f"resume={tmp_path}/runs/run", f"hydra.run.dir={tmp_path / 'hydra'}")
    assert torch.load(run / "checkpoints" / "best.ckpt", weights_only=True)["finished"]


@pytest.mark.parametrize(
    ("section", "part"),
    [
        ("logger", CSV | {"version": "../.."}),
        ("logger", BOARD | {"filename_suffix": "/../../out"}),
        ("callbacks", KEEPER | {"filename": "{epoch}/../../out"}),
    ],
)
def test_names_of_loggers_and_callbacks_lead_nowhere(tmp_path, lnn_run, section, part):
    run = foreign(lnn_run, tmp_path / "run", lambda config: config[section].update(more=part))
    unfinished(run)
    with pytest.raises((ConfigError, SystemExit), match="without separators"):
        run_script("train.py", f"resume={run}", f"hydra.run.dir={tmp_path / 'hydra'}")
