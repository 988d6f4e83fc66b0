"""Data that have changed since a training are refused by name."""

import shutil

import pandas as pd
import pytest
import torch

from pinn_dyn.data import data_identity
from pinn_dyn.run.configuration.build import build_source
from pinn_dyn.run.configuration.validation import ConfigError
from pinn_dyn.run.run_folder import load_run, require_same_data
from tests.app.entry import NO_FIGURES, ROOT, TINY_TRAINING, refused_text, run_script
from tests.support.foreign_runs import foreign

LOG = "example_log.csv"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A log and a run on it."""
    place = tmp_path_factory.mktemp("log")
    shutil.copy(ROOT / "examples" / LOG, place)
    words = ["experiment=example_log", "compile=false", *TINY_TRAINING, NO_FIGURES]
    words += [f"dataset.root={place}", "dataset.files='*.csv'", f"hydra.run.dir={place / 'run'}"]
    run_script("train.py", *words)
    return place


@pytest.fixture
def run(trained, tmp_path):
    """A copy of both, the log where the copied configuration looks for it."""
    place = tmp_path / "log"
    place.mkdir()
    shutil.copy(trained / LOG, place)
    return foreign(trained / "run", place / "run", lambda c: c["dataset"].update(root=str(place)))


def check(folder):
    run = load_run(folder)
    source = build_source(run.config)
    require_same_data(run.folder, run.data, source.name, data_identity(source))


def change_a_number(log):
    lines = log.read_text().splitlines()
    cells = lines[700].split(",")
    cells[-1] = "0.123"
    lines[700] = ",".join(cells)
    log.write_text("\n".join(lines) + "\n")


def add_a_file(log):
    table = pd.read_csv(log)
    numbers = table.select_dtypes("number").columns.drop("t")
    table[numbers] *= 1.1
    table.to_csv(log.with_name("more.csv"), index=False)


def test_unchanged_data_are_accepted(run):
    check(run)
    log = run.parent / LOG
    log.write_text(log.read_text() + "\n")  # another file, the same numbers
    check(run)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (add_a_file, r"example_log:run_00 .* is new in"),
        (change_a_number, r"run_02 .* in \w+ has other values"),
    ],
)
def test_a_changed_log_is_refused_with_what_changed(run, change, message):
    change(run.parent / LOG)
    with pytest.raises(ConfigError, match=message) as caught:
        check(run)
    assert f"has changed since {run} was trained" in str(caught.value)


def test_a_run_that_moved_from_test_to_train_is_named(run):
    path = run / "checkpoints" / "best.ckpt"
    saved = torch.load(path, weights_only=True)
    train, test = saved["data"]["train"], saved["data"]["test"]
    for part in ("names", "lengths", "hashes"):
        train[part].append(test[part].pop())
    train["moments"] = torch.cat([train["moments"], test["moments"][-1:]])
    test["moments"] = test["moments"][:-1]
    torch.save(saved, path)
    with pytest.raises(ConfigError, match=r"run_\d\d .* moved from train to test"):
        check(run)


def test_evaluate_refuses_changed_data(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    change_a_number(run.parent / LOG)
    text = refused_text(capsys, "evaluate.py", f"runs=[{run}]", "hydra.run.dir=out")
    assert "has other values" in text
    assert not (tmp_path / "out" / "summary.csv").exists()
