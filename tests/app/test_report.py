"""The reports that evaluate.py and control.py write, and where they say their numbers come from."""

import json
import shlex

import pandas as pd
import pytest

from pinn_dyn.app.build import build_source
from pinn_dyn.app.provenance import data_hash, provenance
from pinn_dyn.app.run_folder import read_config
from pinn_dyn.app.words import command_line
from tests.app.entry import SET_POINTS, run_script
from tests.evaluation.report_pages import Page


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory, hnn_run, mlp_run):
    folder = tmp_path_factory.mktemp("evaluation")
    runs = f"runs=[{hnn_run},{mlp_run}]"
    run_script("evaluate.py", runs, "horizon=0.1", "windows=[0.02]", f"hydra.run.dir={folder}")
    return folder


@pytest.fixture(scope="module")
def control(tmp_path_factory, lnn_run):
    folder = tmp_path_factory.mktemp("control")
    rest = ["rate=200", "~controllers.truth", f"hydra.run.dir={folder}"]
    run_script("control.py", f"run={lnn_run}", *SET_POINTS, *rest)
    return folder


def read(folder):
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def test_the_page_of_an_evaluation_has_the_numbers_of_its_files(evaluation):
    page, summary = read(evaluation), pd.read_csv(evaluation / "summary.csv")
    rows = page.table("mean error ± std")
    assert [row["run"][0] for row in rows][:3] == ["hnn", "mlp", "[stands still]"]
    for row, value in zip(rows, summary["error_mean"], strict=True):
        assert float(row["mean error ± std"][1]) == value
    terms = pd.read_csv(evaluation / "terms_hnn.csv")
    shown = page.table("|X_L − X| / |X|")
    assert [row["term X"][0] for row in shown] == terms["term"].tolist()
    for row, value in zip(shown, terms["relative_error_best_P"], strict=True):
        assert float(row["|X_L − P X| / |X_L|"][1]) == value


def test_the_page_of_a_control_run_has_the_numbers_of_its_files(control):
    page, summary = read(control), pd.read_csv(control / "summary.csv")
    rows = page.table("RMS error")
    assert [row["law"][0] for row in rows] == ["learned", "pd"]
    for row, value in zip(rows, summary["rms_error"], strict=True):
        assert float(row["RMS error"][1]) == value
    coordinates = pd.read_csv(control / "coordinates.csv")
    shown = page.table("coordinate")
    assert [float(row["max_error"][1]) for row in shown] == coordinates["max_error"].tolist()


@pytest.mark.parametrize("kind", ["evaluation", "control"])
def test_the_page_says_how_it_came_about(kind, request, hnn_run, lnn_run):
    folder = request.getfixturevalue(kind)
    page, record = read(folder), json.loads((folder / "provenance.json").read_text())
    script = "evaluate.py" if kind == "evaluation" else "control.py"
    words = shlex.split(record["command"])
    assert words[:2] == ["python", script]
    assert f"hydra.run.dir={folder}" in words
    for key in ("command", "data_hash", "commit", "hardware", "torch"):
        assert record[key] in page.text
    assert ("with uncommitted changes" in page.text) == (record["uncommitted_changes"] == "yes")
    run = hnn_run if kind == "evaluation" else lnn_run
    (row,) = (row for row in page.table("folder") if row["folder"][0] == str(run))
    assert row["seed"][0] == "0"
    assert row["trained on commit"][0] == json.loads((run / "metrics.json").read_text())["commit"]
    assert "Configuration of this program" in page.text


def test_the_hash_of_a_simulation_is_that_of_its_cache_file(hnn_run, cache):
    config = read_config(hnn_run)
    key = data_hash(build_source(config)).split()[0]
    assert (cache / f"soft_arm_1-{key}.npz").is_file()
    config["dataset"]["seed"] = 1
    assert data_hash(build_source(config)).split()[0] != key


def test_the_command_line_can_be_pasted_into_a_shell(monkeypatch):
    monkeypatch.setattr("sys.argv", ["/somewhere/evaluate.py", "runs=[a b,c]", "horizon=5"])
    assert command_line() == "python evaluate.py 'runs=[a b,c]' horizon=5"
    monkeypatch.setattr("sys.argv", ["/venv/bin/pinn-dyn-evaluate", "runs=[a]"])
    assert command_line() == "pinn-dyn-evaluate 'runs=[a]'"


def test_uncommitted_changes_are_reported(monkeypatch):
    answers = {"rev-parse": "abc1234", "status": " M pinn_dyn/app/run_folder.py"}
    monkeypatch.setattr("pinn_dyn.app.provenance._git", lambda *arguments: answers[arguments[0]])
    assert provenance()["uncommitted_changes"] == "yes"
    answers["status"] = ""
    assert provenance()["uncommitted_changes"] == "no"
    answers["rev-parse"] = ""
    record = provenance()
    assert (record["commit"], record["uncommitted_changes"]) == ("unknown", "unknown")
