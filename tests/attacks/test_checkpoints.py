"""Checkpoints that are damaged, of another run, or hold code: each is refused by name."""

import math
import shutil

import pytest
import torch

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.run_folder import load_run


def damaged(run, folder, change):
    shutil.copytree(run, folder)
    path = folder / "checkpoints" / "best.ckpt"
    change(path)
    return folder


def flip(path):
    """One bit of a stored weight, with the archive's directory left whole."""
    data = bytearray(path.read_bytes())
    position = data.find(b"best/data/0") + 300
    data[position] ^= 0x40
    path.write_bytes(data)


def cut(path):
    path.write_bytes(path.read_bytes()[:-200])


def with_nan(path):
    saved = torch.load(path, weights_only=True)
    key = next(key for key in saved["state_dict"] if key.startswith("model."))
    saved["state_dict"][key] = torch.full_like(saved["state_dict"][key], math.nan)
    torch.save(saved, path)


def of_another_data_set(path):
    saved = torch.load(path, weights_only=True)
    saved["hyper_parameters"]["config"]["dataset"]["system"]["segments"] = 2
    torch.save(saved, path)


def of_another_model(path):
    saved = torch.load(path, weights_only=True)
    saved["hyper_parameters"]["config"]["model"]["mass"]["hidden"] = [8]
    torch.save(saved, path)


def without_parts(path):
    torch.save({"state_dict": {}}, path)


def a_pickle(path):
    torch.save({"state_dict": Path, "hyper_parameters": {}}, path)


class Path:
    """Stands for any class: with weights_only it is not even looked up."""


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (flip, "cannot be read, it may be cut short: .* has another checksum"),
        (cut, "cannot be read, it may be cut short"),
        (with_nan, "holds weights that are NaN"),
        (of_another_data_set, "another data set .*segments is 1, the checkpoint has 2"),
        (of_another_model, "another model .*mass.hidden is"),
        (without_parts, "is no checkpoint that train.py wrote"),
        (a_pickle, "cannot be read"),
        (lambda path: path.write_bytes(b""), "cannot be read"),
        (lambda path: path.unlink(), "does not exist; .* has last"),
    ],
)
def test_a_damaged_checkpoint_is_refused_by_name(tmp_path, lnn_run, change, expected):
    run = damaged(lnn_run, tmp_path / "run", change)
    with pytest.raises(ConfigError, match=expected) as caught:
        load_run(run, "best")
    assert str(run / "checkpoints" / "best.ckpt") in str(caught.value)


def test_the_comparison_comes_before_the_model_is_built(tmp_path, monkeypatch, lnn_run):
    monkeypatch.setattr(
        "pinn_dyn.app.run_folder.build_predictor", lambda *_: pytest.fail("it was built")
    )
    with pytest.raises(ConfigError, match="another model"):
        load_run(damaged(lnn_run, tmp_path / "run", of_another_model), "best")
