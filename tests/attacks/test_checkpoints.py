"""Checkpoints that are damaged, of another model, or hold code: each is refused by its path."""

import math
import shutil

import pytest
import torch

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.run_folder import load_run


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
    "zero step": (statistics("step", 0.0), "statistics.step .* expected .* positive"),
    "NaN mean": (statistics("q_mean", [math.nan] * 3), "statistics.q_mean .* finite numbers"),
    "negative spread": (statistics("v_std", [-1.0] * 3), "statistics.v_std .*positive numbers"),
}


@pytest.mark.parametrize(("change", "expected"), DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_checkpoint_is_refused_by_name(tmp_path, lnn_run, change, expected):
    run = tmp_path / "run"
    shutil.copytree(lnn_run, run)
    path = run / "checkpoints" / "best.ckpt"
    change(path)
    with pytest.raises(ConfigError, match=expected) as caught:
        load_run(run, "best")
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 900
