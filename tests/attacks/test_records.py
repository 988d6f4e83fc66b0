"""Records beside a run, damaged or made up: read by gather.py, by evaluate.py and by a resume."""

import json
import shutil

import pytest

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.run_folder import load_run, read_metrics
from tests.app.entry import run_script

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
    assert "1 runs" in text
    assert "5 jobs have no result" in text
