"""What a training leaves behind, and sweeps."""

import json
import re
import shutil
from pathlib import Path

import pytest
import torch
import yaml

from pinn_dyn.models.cholesky import free_weights
from pinn_dyn.run.run_folder import load_run
from tests.app.entry import NO_FIGURES, TINY, assert_trained, refused_text, run_script, train

PLAIN = (str, int, float, bool, type(None))


def assert_plain(value, where="hyper_parameters"):
    """Nested dicts and lists of plain values; exact types, as a subclass needs its own code."""
    if type(value) in (dict, list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, item in items:
            assert type(key) in (str, int), f"{where}: key {key!r}"
            assert_plain(item, f"{where}.{key}")
    else:
        assert type(value) in PLAIN, f"{where} is a {type(value)}"


def load(run, name="best"):
    return torch.load(run / "checkpoints" / f"{name}.ckpt", weights_only=True)


@pytest.mark.parametrize("name", ["best", "last"])
def test_checkpoints_hold_plain_hyperparameters(hnn_run, name):
    saved = load(hnn_run, name)
    assert_plain(saved["hyper_parameters"])
    assert saved["finished"]
    assert saved["record"] == json.loads((hnn_run / "metrics.json").read_text())
    assert len(saved["data"]["train"]["hashes"]) == 4
    config = yaml.safe_load((hnn_run / "config.yaml").read_text())
    assert config == saved["hyper_parameters"]["config"]
    assert saved["hyper_parameters"]["statistics"]["step"] == pytest.approx(0.01)
    assert any(key.startswith("model.") for key in saved["state_dict"])


def test_metrics_are_written_with_their_provenance(hnn_run):
    record = json.loads((hnn_run / "metrics.json").read_text())
    assert record["pairs"] == 64
    assert record["steps"] == 4
    assert record["seed"] == 0
    assert record["training_seconds"] > 0
    assert record["validation"]["val/error_mean"] > 0
    assert re.fullmatch(r"[0-9a-f]{7,40}|unknown", record["commit"])
    assert record["torch"] == torch.__version__
    assert {"python", "hardware"} <= record.keys()
    parameters = load_run(hnn_run, "best").model.parameters()
    assert record["parameters"] == sum(x.numel() for x in parameters)


def test_a_training_starts_from_the_best_weights_of_another_run(tmp_path, hnn_run):
    """With a learning rate of next to nothing it also ends there; its windows may be longer."""
    earlier = Path(shutil.copytree(hnn_run, tmp_path / "earlier"))
    last = load(earlier, "last")
    for value in last["state_dict"].values():
        value.zero_()
    torch.save(last, earlier / "checkpoints" / "last.ckpt")
    run = train(
        tmp_path / "run",
        "model=hnn",
        f"start_from={earlier}",
        "data.steps=2",
        "optimizer.lr=1e-9",
        NO_FIGURES,
    )
    before, after = (load_run(folder, "best").model.state_dict() for folder in (hnn_run, run))
    for name, value in free_weights(before).items():  # limits are of other windows
        torch.testing.assert_close(after[name], value, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("model=lnn", "start_from: .* is of another model"),
        ("start_from=nowhere", "nowhere/checkpoints/best.ckpt does not exist"),
    ],
)
def test_weights_that_do_not_fit_are_refused(tmp_path, capsys, hnn_run, override, expected):
    arguments = [*TINY, "model=hnn", f"start_from={hnn_run}", override, NO_FIGURES]
    text = refused_text(capsys, "train.py", *arguments, f"hydra.run.dir={tmp_path}")
    assert re.search(expected, " ".join(text.split()))


def test_a_seed_gives_the_same_weights_again_and_another_seed_gives_others(
    tmp_path, lnn_run, run_of
):
    again = train(tmp_path / "again", "model=lnn", NO_FIGURES)
    runs = lnn_run, again, run_of("other seed")
    first, again, other = (load(run)["state_dict"] for run in runs)
    assert first.keys() == again.keys() == other.keys()
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert any(not torch.equal(first[key], other[key]) for key in first)


def test_runs_go_to_a_folder_named_by_data_set_model_and_seed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_script("train.py", *TINY, NO_FIGURES, "model=acceleration", "seed=3")
    (folder,) = (tmp_path / "runs" / "soft_arm_1" / "acceleration-seed3").iterdir()
    assert_trained(folder)


def test_a_step_too_long_for_the_fastest_motion_is_named(tmp_path, capsys):
    words = ["dataset.step=0.05", "data.stride=1", NO_FIGURES, f"hydra.run.dir={tmp_path}"]
    run_script("train.py", *TINY, *words)
    text = capsys.readouterr().out
    assert "a step of 0.05 s is too long for the fastest motion in the data, that of" in text
