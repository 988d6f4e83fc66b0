"""Records beside a run, damaged or made up: read by gather.py, by evaluate.py and by a resume."""

import json
import shutil

import pytest

from pinn_dyn.app import jobs
from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.jobs import find_jobs, find_runs
from pinn_dyn.app.run_folder import load_run, read_metrics
from tests.app.entry import refused_text, run_script

RECORDS = {
    "empty": "",
    "cut": '{"seed": 0, "valid',
    "a list": "[1, 2]",
    "a number": "7",
    "null": "null",
    "deep": "[" * 100_000,
    "binary": "\ud800\x00",
    "a list of errors": '{"validation": [1]}',
    "errors in words": '{"validation": {"val/error_mean": "small"}}',
    "pairs in words": '{"pairs": "many", "validation": {}}',
    "time in words": '{"training_seconds": "long", "validation": {}}',
    "pairs of true": '{"pairs": true, "validation": {}}',
    "endless digits": '{"pairs": ' + "9" * 5000 + "}",
    "steps of null": '{"steps": null, "validation": {}}',
}


@pytest.fixture
def run(tmp_path, lnn_run):
    shutil.copytree(lnn_run, tmp_path / "run")
    return tmp_path / "run"


@pytest.mark.parametrize("text", RECORDS.values(), ids=RECORDS)
def test_a_record_that_is_none_is_named(run, text):
    (run / "metrics.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    for read in (read_metrics, lambda folder: load_run(folder, "best")):
        with pytest.raises(ConfigError, match=r"cannot be read|holds no record") as caught:
            read(run)
        assert str(run / "metrics.json") in str(caught.value)
    (job,) = find_jobs(str(run))
    assert job.record is None
    assert job.problem == "failed: metrics.json cannot be read, it may be cut short"


def test_a_folder_of_damaged_and_whole_runs_is_gathered(tmp_path, run, capsys):
    for name, file, content in [
        ("a", "config.yaml", "a: &a [*a]"),
        ("b", "config.yaml", "seed: [1"),
        ("c", "metrics.json", "[]"),
        ("d", "config.yaml", json.dumps({"trainer": {}, "seed": "x"})),
        ("e", "metrics.json", ""),
    ]:
        shutil.copytree(run, tmp_path / "runs" / name)
        (tmp_path / "runs" / name / file).write_text(content)
    shutil.copytree(run, tmp_path / "runs" / "whole")
    run_script("gather.py", f"runs={tmp_path / 'runs'}", f"hydra.run.dir={tmp_path / 'out'}")
    text = capsys.readouterr().out
    assert "runs: 1," in text
    assert "jobs have no result" in text
    assert "metrics.json cannot be read" in text


def test_an_empty_error_is_one(tmp_path, run):
    (run / "metrics.json").unlink()
    (run / "error.txt").write_text("")
    (job,) = find_jobs(str(run))
    assert job.problem == "failed: without a word: was the disk full?"


def test_an_evaluation_that_was_cut_is_passed_over(tmp_path, run, capsys):
    for name in ("cut", "empty"):
        (tmp_path / "evaluation" / name).mkdir(parents=True)
        (tmp_path / "evaluation" / name / "summary.csv").write_text(
            "" if name == "empty" else "run,"
        )
    words = [f"runs={run}", f"evaluations={tmp_path / 'evaluation'}/*", "hydra.run.dir=out"]
    text = refused_text(capsys, "gather.py", *words)
    assert (
        f"passed over: {tmp_path / 'evaluation' / 'empty' / 'summary.csv'} cannot be read" in text
    )
    assert "knows any of these runs" in text


def test_a_large_folder_is_not_walked_without_a_word(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(jobs, "MANY_FOLDERS", 10)
    monkeypatch.setattr(jobs, "MOST_FOLDERS", 30)
    for k in range(40):
        (tmp_path / "disk" / str(k)).mkdir(parents=True)
    with pytest.raises(
        ConfigError, match="has more than 30 folders below it, expected run folders"
    ):
        find_jobs(str(tmp_path / "disk"))
    assert f"looking through all folders below {tmp_path / 'disk'}" in caplog.text


def test_a_circle_of_links_is_not_followed(tmp_path, run):
    (run / "again").symlink_to(run)
    assert len(find_jobs(str(run))) == 1


@pytest.mark.parametrize(
    "pattern", ["", ".", "nowhere", "nowhere/**", "[", "~nobody/x", "/dev/null", "a\0b"]
)
def test_a_pattern_that_finds_no_run(tmp_path, pattern):
    (tmp_path / "empty").mkdir()
    for find in (find_jobs, find_runs):
        with pytest.raises(ConfigError, match="runs"):
            find(pattern)
