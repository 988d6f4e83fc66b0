"""Checkpoints that are damaged, of another run, or hold code: each is refused by name."""

import math
import shutil
import zipfile

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


def of_another_module(path):
    saved = torch.load(path, weights_only=True)
    model = saved["hyper_parameters"]["config"]["model"]
    model["_target_"] = f"elsewhere.{model['_target_'].rpartition('.')[2]}"
    torch.save(saved, path)


def stored(change):
    """A change of what a checkpoint holds."""

    def apply(path):
        saved = torch.load(path, weights_only=True)
        change(saved)
        torch.save(saved, path)

    return apply


def scale(name, value):
    """Other scales of the data than a training has."""
    return stored(lambda saved: saved["hyper_parameters"]["statistics"].update({name: value}))


def weights(change):
    def apply(saved):
        saved["state_dict"] = {key: change(x) for key, x in saved["state_dict"].items()}

    return stored(apply)


def compressed(path):
    """Megabytes of zeros in some bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("best/data.pkl", bytes(50_000_000))


FORGED = {
    "a step of zero": (scale("step", 0.0), "statistics.step .* expected .* positive"),
    "a step of NaN": (scale("step", math.nan), "statistics.step has 1 numbers, expected finite"),
    "a step in words": (scale("step", "x"), "statistics.step holds no numbers"),
    "an unknown scale": (scale("evil", [1.0]), "statistics has .*evil, expected q_mean"),
    "a mean in words": (scale("q_mean", "abc"), "statistics.q_mean holds no numbers"),
    "a mean of NaN": (scale("q_mean", [math.nan] * 3), "statistics.q_mean has 3 numbers"),
    "few means": (scale("q_mean", [0.0]), r"statistics.* has shape .*expected"),
    "many means": (scale("q_mean", [0.0] * 10**5), "statistics.q_mean has 100000 numbers"),
    "no inputs": (scale("u_mean", []), "statistics.u_"),
    "a spread of zero": (scale("q_std", [0.0] * 3), "statistics.q_std .*positive numbers"),
    "a spread below": (scale("v_std", [-1.0] * 3), "statistics.v_std .*positive numbers"),
    "a ragged spread": (scale("q_std", [[1.0], [1.0, 2.0]]), "statistics.q_std holds no numbers"),
    "a flat increment": (scale("qv_increment_std", [1.0] * 6), "statistics.qv_increment_std"),
    "no increment": (scale("qv_increment_std", []), "statistics.qv_increment_std"),
    "infinite": (weights(lambda x: torch.full_like(x, math.inf)), "NaN or infinite"),
    "complex": (weights(lambda x: x.to(torch.complex64)), "another model .*complex64"),
    "whole numbers": (weights(lambda x: x.to(torch.int8)), "another model .*int8"),
    "true and false": (weights(lambda x: x.bool()), "another model .*bool"),
    "sparse": (weights(lambda x: x.to_sparse()), "another model"),
    "of no device": (weights(lambda x: torch.empty_like(x, device="meta")), "another model"),
    "endless": (weights(lambda x: torch.zeros(1).expand(10**12)), "1000000000000"),
    "one too many": (
        stored(lambda saved: saved["state_dict"].update({"model.evil": torch.ones(1)})),
        "only one of them has evil",
    ),
    "none": (stored(lambda saved: saved.update(state_dict={})), "only one of them has"),
    "without names": (
        stored(lambda saved: saved.update(state_dict={1: torch.ones(1)})),
        "is no checkpoint that train.py wrote",
    ),
    "compressed": (compressed, "it is compressed, which no checkpoint is"),
}


@pytest.mark.parametrize(("change", "expected"), FORGED.values(), ids=FORGED)
def test_a_forged_checkpoint_is_refused_by_name(tmp_path, lnn_run, change, expected):
    run = damaged(lnn_run, tmp_path / "run", change)
    with pytest.raises(ConfigError, match=expected) as caught:
        load_run(run, "best")
    assert str(run / "checkpoints" / "best.ckpt") in str(caught.value)
    assert len(str(caught.value)) < 900


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
        (with_nan, "holds weights that are NaN or infinite"),
        (of_another_data_set, "another data set .*segments is 1, the checkpoint has 2"),
        (of_another_model, "another model .*mass.hidden is"),
        (of_another_module, "another model .*in the module of a class"),
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
