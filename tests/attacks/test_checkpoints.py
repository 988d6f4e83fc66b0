"""Checkpoints that are damaged, of another run, or hold code: each is refused by name."""

import math
import shutil

import pytest
import torch

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.run_folder import load_run


def flip(path):
    """Flip one bit of a stored weight, with the archive's directory left whole."""
    data = bytearray(path.read_bytes())
    position = data.find(b"best/data/0") + 300
    data[position] ^= 0x40
    path.write_bytes(data)


def cut(path):
    path.write_bytes(path.read_bytes()[:-200])


def stored(change):
    """Return a change of the contents of a checkpoint."""

    def apply(path):
        saved = torch.load(path, weights_only=True)
        change(saved)
        torch.save(saved, path)

    return apply


def scale(name, value):
    """Return a change of a scale of the data."""
    return stored(lambda saved: saved["hyper_parameters"]["statistics"].update({name: value}))


def weights(change):
    def apply(saved):
        saved["state_dict"] = {key: change(x) for key, x in saved["state_dict"].items()}

    return stored(apply)


def config(change):
    return stored(lambda saved: change(saved["hyper_parameters"]["config"]))


class Foreign:
    """Stands for any class: with weights_only it is not even looked up."""


DAMAGED = {
    "a flipped bit": (flip, "may be cut short: .* has another checksum"),
    "cut short": (cut, "may be cut short"),
    "empty": (lambda path: path.write_bytes(b""), "cannot be read"),
    "missing": (lambda path: path.unlink(), "does not exist: .* has last"),
    "a pickled class": (lambda path: torch.save({"state_dict": Foreign}, path), "cannot be read"),
    "without a configuration": (
        lambda path: torch.save({"state_dict": {}}, path),
        "cannot be read",
    ),
    "weights of NaN": (weights(lambda x: torch.full_like(x, math.nan)), "NaN or infinite"),
    "no weights": (stored(lambda saved: saved.update(state_dict={})), "another model"),
    "weights of another model": (
        config(lambda values: values["model"]["mass"].update(hidden=[8])),
        "weights of another model",
    ),
    "a class of another package": (
        config(lambda values: values["model"].update(_target_="elsewhere.LagrangianNetwork")),
        "may name the classes of pinn_dyn",
    ),
    "a step of zero": (scale("step", 0.0), "step"),
    "a mean of NaN": (scale("q_mean", [math.nan] * 3), "q_mean"),
    "few means": (scale("q_mean", [0.0]), "shape"),
    "a spread of zero": (scale("q_std", [0.0] * 3), "q_std"),
}


@pytest.mark.parametrize(("change", "message"), DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_checkpoint_is_refused_by_name(tmp_path, lnn_run, change, message):
    run = tmp_path / "run"
    shutil.copytree(lnn_run, run)
    path = run / "checkpoints" / "best.ckpt"
    change(path)
    with pytest.raises(ConfigError, match=message) as caught:
        load_run(run, "best")
    assert str(path) in str(caught.value)
