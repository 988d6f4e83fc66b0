"""Data that have changed since a training: evaluate.py and resume= say what, and refuse."""

import json
import re
import shutil

import pandas as pd
import pytest

from pinn_dyn.app.build import build_source
from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.data_record import check_data
from pinn_dyn.app.run_folder import read_config
from tests.app.entry import NO_FIGURES, ROOT, TINY_TRAINING, refused_text, run_script
from tests.support.foreign_runs import foreign

LOG = "example_log.csv"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A log and a run on it."""
    place = tmp_path_factory.mktemp("log")
    shutil.copy(ROOT / "examples" / LOG, place)
    words = ["experiment=example_log", "compile=false", *TINY_TRAINING, NO_FIGURES]
    run_script(
        "train.py", *words, f"dataset.root={place}", "dataset.files='*.csv'",
        f"hydra.run.dir={place / 'run'}",
    )  # fmt: skip
    return place


@pytest.fixture
def run(trained, tmp_path):
    """A copy of both, the log where the copied configuration looks for it."""
    place = tmp_path / "log"
    place.mkdir()
    shutil.copy(trained / LOG, place)
    return foreign(trained / "run", place / "run", lambda c: c["dataset"].update(root=str(place)))


def check(run):
    check_data(run, build_source(read_config(run)))


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


def test_a_run_records_its_data_and_accepts_them(run):
    record = json.loads((run / "data.json").read_text())
    assert record["files"].keys() == {LOG}
    assert record["splits"].keys() == {"train", "validation", "test"}
    assert record["splits"]["test"]
    check(run)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (add_a_file, "file more.csv was added"),
        (change_a_number, f"file {LOG} was edited: it had"),
        (lambda log: log.rename(log.with_name("other.csv")), f"file {LOG} is gone"),
    ],
)
def test_a_changed_log_is_refused_with_what_changed(run, change, expected):
    change(run.parent / LOG)
    with pytest.raises(ConfigError, match=expected) as caught:
        check(run)
    assert f"has changed since {run} was trained" in str(caught.value)
    assert f"delete {run / 'data.json'}" in str(caught.value)


def test_a_run_that_moved_from_test_to_train_is_named(run):
    record = json.loads((run / "data.json").read_text())
    record["splits"]["train"].append(moved := record["splits"]["test"].pop())
    (run / "data.json").write_text(json.dumps(record))
    with pytest.raises(ConfigError) as caught:
        check(run)
    assert f"{moved} moved from train to test" in str(caught.value)


@pytest.mark.parametrize(
    "content", ["", "{", "[]", "3", '{"files": 3}', '{"splits": {"train": 3}}', "[" * 100_000]
)
def test_a_damaged_record_is_named(run, content):
    (run / "data.json").write_text(content)
    with pytest.raises(ConfigError, match=r"data.json cannot be read|has changed since"):
        check(run)


def test_a_run_without_a_record_is_only_warned_about(run, caplog):
    (run / "data.json").unlink()
    check(run)
    assert f"{run} has no data.json" in caplog.text


@pytest.mark.parametrize("command", ["evaluate", "resume"])
def test_both_programs_refuse(run, tmp_path, monkeypatch, capsys, command):
    monkeypatch.chdir(tmp_path)
    change_a_number(run.parent / LOG)
    words = {
        "evaluate": ["evaluate.py", f"runs=[{run}]", "hydra.run.dir=out"],
        "resume": ["train.py", f"resume={run}"],
    }
    text = refused_text(capsys, *words[command])
    assert f"file {LOG} was edited" in text
    assert not (tmp_path / "out" / "summary.csv").exists()


def test_a_simulated_data_set_with_another_constant_is_refused(tmp_path, lnn_run):
    """Beside an unchanged configuration: here the record is of another arm."""
    run = tmp_path / "run"
    shutil.copytree(lnn_run, run)
    check(run)
    record = json.loads((run / "data.json").read_text())
    record["step"] = 0.5
    (run / "data.json").write_text(json.dumps(record))
    with pytest.raises(ConfigError, match=r"step was 0\.5, now it is 0\.002"):
        check(run)


def edit_code(record):
    """As if another version of the program had written it."""
    text = json.dumps(record)
    edited = re.sub(r'("class": "\w+ )[0-9a-f]{16}"', r'\g<1>0123456789abcdef"', text)
    assert edited != text
    return json.loads(edited)


def test_edited_code_that_makes_the_same_data_is_accepted(run):
    """A run of an older version; where its data come out otherwise, the code is named."""
    path = run / "data.json"
    record = edit_code(json.loads(path.read_text()))
    path.write_text(json.dumps(record))
    check(run)
    record["moments"]["test"]["q"]["mean"][0] += 1e-3
    path.write_text(json.dumps(record))
    with pytest.raises(ConfigError, match=r"the code of .* was edited"):
        check(run)


def test_same_moments_do_not_excuse_another_file(run):
    path = run / "data.json"
    record = edit_code(json.loads(path.read_text()))
    record["files"][LOG]["bytes"] += 1
    path.write_text(json.dumps(record))
    with pytest.raises(ConfigError, match=f"file {LOG} was edited"):
        check(run)


def test_edited_code_of_a_simulation(tmp_path, lnn_run):
    run = tmp_path / "run"
    shutil.copytree(lnn_run, run)
    path = run / "data.json"
    record = edit_code(json.loads(path.read_text()))
    path.write_text(json.dumps(record))
    check(run)
    record["moments"]["train"]["u"]["std"][0] *= 1.001
    path.write_text(json.dumps(record))
    with pytest.raises(ConfigError, match="the code of system was edited"):
        check(run)
