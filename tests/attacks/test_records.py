"""Files of a run that are damaged or of another run."""

import shutil

import pytest
import torch

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.run_folder import load_run, read_metrics
from tests.app.entry import NO_FIGURES, TINY, refused_text, train

RECORDS = {
    "empty": "",
    "cut": '{"seed": 0, "valid',
    "a list": "[1, 2]",
    "null": "null",
    "binary": "\ud800\x00",
    "a list of errors": '{"validation": [1]}',
}


@pytest.fixture
def run(tmp_path, lnn_run):
    return shutil.copytree(lnn_run, tmp_path / "run")


@pytest.mark.parametrize("text", RECORDS.values(), ids=RECORDS)
def test_a_damaged_record_is_named_and_not_needed(run, text):
    (run / "metrics.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(ConfigError, match=r"metrics.json cannot be read"):
        read_metrics(run)
    assert load_run(run).metrics["seed"] == 0


@pytest.fixture(scope="module")
def other_seed(tmp_path_factory):
    return train(tmp_path_factory.mktemp("runs") / "other", "model=lnn", "seed=1", NO_FIGURES)


def test_a_run_folder_is_what_its_checkpoint_says(run, other_seed):
    shutil.copy(other_seed / "checkpoints" / "best.ckpt", run / "checkpoints" / "best.ckpt")
    loaded = load_run(run)
    assert loaded.config["seed"] == loaded.metrics["seed"] == 1


def test_a_training_does_not_go_on_in_the_folder_of_another(run, other_seed, capsys):
    shutil.copy(other_seed / "checkpoints" / "last.ckpt", run / "checkpoints" / "last.ckpt")
    words = ["model=lnn", NO_FIGURES, f"hydra.run.dir={run}"]
    text = refused_text(capsys, "train.py", *TINY, *words)
    assert "holds a training of another configuration: seed=0 (there 1)" in " ".join(text.split())


def test_weights_of_another_model_are_refused(run, hnn_run):
    path = run / "checkpoints" / "best.ckpt"
    saved = torch.load(path, weights_only=True)
    other = torch.load(hnn_run / "checkpoints" / "best.ckpt", weights_only=True)
    torch.save({**saved, "state_dict": other["state_dict"]}, path)
    with pytest.raises(ConfigError, match=r"best.ckpt: weights of another model: .*Lagrangian"):
        load_run(run)


def test_weights_that_are_not_finite_are_refused(run):
    path = run / "checkpoints" / "best.ckpt"
    saved = torch.load(path, weights_only=True)
    next(iter(saved["state_dict"].values())).fill_(torch.nan)
    torch.save(saved, path)
    with pytest.raises(ConfigError, match=r"are NaN or infinite, the training diverged"):
        load_run(run)
