"""Checkpoints that are damaged, of another model, or hold code: each is refused by its path."""

import math
import shutil

import pytest
import torch

from pinn_dyn.run.configuration.validation import ConfigError
from pinn_dyn.run.run_folder import load_run
from tests.app.entry import NO_FIGURES, TINY, refused_text


def flip_a_bit(path):
    """Flip one bit of a stored weight; the directory of the archive stays intact."""
    data = bytearray(path.read_bytes())
    data[data.find(b"best/data/0") + 300] ^= 0x40
    path.write_bytes(data)


def edit(change):
    """Return a function that changes the contents of a checkpoint."""

    def apply(path):
        saved = torch.load(path, weights_only=True)
        change(saved)
        torch.save(saved, path)

    return apply


def weights(change):
    return edit(
        lambda saved: saved.update(
            state_dict={key: change(value) for key, value in saved["state_dict"].items()}
        )
    )


def statistics(name, value):
    return edit(lambda saved: saved["hyper_parameters"]["statistics"].update({name: value}))


class Path:
    """Stands for any class: with ``weights_only`` it is never looked up."""


DAMAGE = {
    "bit": (flip_a_bit, "cannot be read, it may be cut short: .* has another checksum"),
    "cut": (lambda path: path.write_bytes(path.read_bytes()[:-200]), "may be cut short"),
    "empty": (lambda path: path.write_bytes(b""), "cannot be read"),
    "missing": (lambda path: path.unlink(), "does not exist: .* has last"),
    "class": (lambda path: torch.save({"state_dict": Path}, path), "cannot be read"),
    "no config": (lambda path: torch.save({"state_dict": {}}, path), "cannot be read"),
    "NaN weights": (weights(lambda x: torch.full_like(x, math.nan)), "NaN or infinite"),
    "no weights": (edit(lambda saved: saved.update(state_dict={})), "another model"),
    "extra weight": (
        edit(lambda saved: saved["state_dict"].update({"model.extra": torch.ones(1)})),
        "another model.*extra",
    ),
    "other sizes": (weights(lambda x: torch.cat([x, x]) if x.ndim else x), "another model"),
    "zero step": (statistics("step", 0.0), "statistics.step .* expected positive"),
    "NaN mean": (statistics("q_mean", [math.nan] * 3), "statistics.q_mean .* finite numbers"),
    "negative spread": (statistics("v_std", [-1.0] * 3), "statistics.v_std .*positive numbers"),
}


@pytest.fixture
def run(tmp_path, lnn_run):
    return shutil.copytree(lnn_run, tmp_path / "run")


@pytest.mark.parametrize(("change", "expected"), DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_checkpoint_is_refused_by_name(run, change, expected):
    path = run / "checkpoints" / "best.ckpt"
    change(path)
    with pytest.raises(ConfigError, match=expected) as caught:
        load_run(run, "best")
    assert str(path) in str(caught.value)


def test_weights_of_another_model_are_refused(run, mlp_run):
    path = run / "checkpoints" / "best.ckpt"
    other = torch.load(mlp_run / "checkpoints" / "best.ckpt", weights_only=True)
    edit(lambda saved: saved.update(state_dict=other["state_dict"]))(path)
    with pytest.raises(ConfigError, match=r"best.ckpt.*: weights of another model: .*Lagrangian"):
        load_run(run)


def test_a_run_folder_is_what_its_checkpoint_says(run_of, run, capsys):
    other = run_of("other seed")
    for name in ("best", "last"):
        shutil.copy(other / "checkpoints" / f"{name}.ckpt", run / "checkpoints")
    (run / "metrics.json").write_text("damaged")
    loaded = load_run(run)
    assert loaded.config["seed"] == loaded.metrics["seed"] == 1
    words = ["model=lnn", NO_FIGURES, f"hydra.run.dir={run}"]
    text = refused_text(capsys, "train.py", *TINY, *words)
    assert "holds a training of another configuration: seed=0 (there 1)" in " ".join(text.split())
