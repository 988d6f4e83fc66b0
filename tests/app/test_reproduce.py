"""reproduce.py: entries run, are passed over, go on, fail alone, and say how long they take."""

import shutil
import subprocess
import sys
import types
from pathlib import Path

import pandas as pd
import pytest
import yaml

import reproduce
from tests.app.entry import NO_FIGURES, TINY, run_script

ENTRIES = {
    "arm/bad": {"train": ["bad"], "evaluate": [], "minutes": 1},
    "arm/lnn": {
        "train": ["seed=0,1"],
        "evaluate": ["horizon=5"],
        "select": {"model": "lnn"},
        "minutes": 7,
        "paper": "0.171 ± 0.272",
    },
    "control/lnn": {"runs": ["arm/lnn"], "control": ["experiment=x"], "minutes": 5},
    "arm/rk4": {"runs": ["arm/lnn"], "train": ["loss=x"], "evaluate": [], "minutes": 2},
    "arm/beyond": {"runs": ["arm/lnn"], "evaluate": ["dataset=x"], "minutes": 1},
    "real/lnn": {"missing": "no log", "paper": "2.4"},
}


@pytest.fixture
def calls(tmp_path, monkeypatch):
    """Programs that leave what the real ones would; returns the names of those called."""
    names = []

    def call(command, check):
        assert command[0] == sys.executable
        names.append(Path(command[1]).name)
        words = dict(word.partition("=")[::2] for word in command[2:])
        if "bad" in words:
            return subprocess.CompletedProcess(command, 1)
        if names[-1] == "train.py":
            seeds = map(int, words["seed"].split(","))
            if "loss" in words:
                start = Path(words["start_from"])
                assert yaml.safe_load((start / "metrics.json").read_text()) == {
                    "seed": int(words["seed"])
                }
            for seed in seeds:  # a finished training is passed over
                path = Path(words["hydra.sweep.dir"]) / f"{seed}_lnn-seed{seed}" / "metrics.json"
                path.parent.mkdir(parents=True, exist_ok=True)
                if not path.exists():
                    path.write_text(f'{{"seed": {seed}}}')
        else:
            runs = words.get("runs", words.get("run")).strip("[]").split(",")
            assert all((Path(run) / "metrics.json").is_file() for run in runs)
            rows = {"model": "lnn", "error_mean": [0.1, 0.3]}
            path = Path(words["hydra.run.dir"]) / "summary.csv"
            path.parent.mkdir(parents=True, exist_ok=True)
            pd.DataFrame(rows).to_csv(path, index=False)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(reproduce, "subprocess", types.SimpleNamespace(run=call))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "entries.yaml").write_text(yaml.safe_dump({"entries": ENTRIES}, sort_keys=False))
    return names


def call(*words):
    reproduce.main(["--entries", "entries.yaml", *words])


def fails(*words):
    with pytest.raises(SystemExit) as caught:
        call(*words)
    return str(caught.value.code)


def test_an_entry_that_fails_is_listed_and_does_not_stop_the_others(calls, capsys):
    assert fails().split("\n")[1:] == [
        "1 failed:",
        "  arm/bad: train.py ended with status 1, its output says why",
    ]
    assert calls == [
        *("train.py", "train.py", "evaluate.py", "control.py", "control.py"),
        *("train.py", "train.py", "evaluate.py", "evaluate.py"),  # arm/rk4, arm/beyond
    ]
    said = capsys.readouterr().out
    assert said.startswith("16 min to go")
    assert "[2/5] arm/lnn: 7 min" in said
    assert (
        "arm/lnn                                            0.2           -   0.171 ± 0.272" in said
    )


def test_what_is_done_is_passed_over_and_what_is_not_goes_on(calls, tmp_path):
    call("--only", "control/lnn")  # with the entry that it needs
    assert calls == ["train.py", "evaluate.py", "control.py", "control.py"]
    call("--only", "control/lnn")
    assert calls[4:] == ["train.py"]  # which looks for changes of the configuration
    folder = tmp_path / "runs" / "reproduce"
    (folder / "arm" / "lnn" / "1_lnn-seed1" / "metrics.json").unlink()
    (folder / "control" / "lnn" / "0_lnn-seed0" / "summary.csv").unlink()
    call("--only", "control/lnn")
    assert calls[5:] == ["train.py", "evaluate.py", "control.py"]


def test_the_list_says_how_long_each_takes_and_how_far_it_is(calls, tmp_path, capsys):
    fails()
    capsys.readouterr()
    shutil.rmtree(tmp_path / "runs" / "reproduce" / "control")
    call("--list")
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines == [
        ["arm/bad", "1", "min", "to", "do"],
        ["arm/lnn", "7", "min", "done"],
        ["control/lnn", "5", "min", "to", "do"],
        ["arm/rk4", "2", "min", "done"],
        ["arm/beyond", "1", "min", "done"],
        ["real/lnn", "no", "data"],
        ["6", "min", "to", "go,", "on", "one", "core"],
    ]


def test_an_entry_starts_from_runs_of_others_with_their_seeds(calls, tmp_path):
    call("--only", "arm/rk4", "arm/beyond")
    assert calls == [
        "train.py",
        "evaluate.py",
        "train.py",
        "train.py",
        "evaluate.py",
        "evaluate.py",
    ]
    folder = tmp_path / "runs" / "reproduce" / "arm"
    assert len(reproduce.trained(folder / "rk4")) == 2
    assert not reproduce.trained(folder / "beyond")
    assert (folder / "beyond" / "evaluation" / "summary.csv").is_file()


def test_the_entries_that_an_entry_needs_are_run_first():
    a, b, c = ({"train": [], "evaluate": []} for _ in range(3))
    entries = {"a": a, "other": {**a}, "b": {**b, "runs": ["a"]}, "c": {**c, "runs": ["b"]}}
    assert reproduce.chosen(entries, ["c"]) == ["a", "b", "c"]


def test_models_of_one_entry_are_compared_each_with_its_own(tmp_path, monkeypatch):
    monkeypatch.setattr(reproduce, "ROOT", tmp_path)
    rows = {"model": ["hnn", "lnn", "lnn", "mlp"], "error_mean": [0.1, 0.2, 0.4, 0.7]}
    pd.DataFrame(rows).to_csv(tmp_path / "a.csv", index=False)
    entry = {"results": "a.csv", "select": {"model": ["hnn", "lnn"]}}
    said = reproduce.comparison({"a": entry}, ["a"], tmp_path / "out").split("\n")[1:]
    assert [line.split()[:4] for line in said] == [
        ["a", "hnn", "-", "0.1"],
        ["a", "lnn", "-", "0.3"],
    ]


def test_an_entry_takes_the_recorded_time(tmp_path, monkeypatch):
    monkeypatch.setattr(reproduce, "ROOT", tmp_path)
    rows = {
        "model": ["hnn", "hnn", "mlp"],
        "training_seconds": [100.0, 90.0, 1000.0],
        "training_cpu_seconds": [60.0, None, 1000.0],  # the second run did not count them
    }
    pd.DataFrame(rows).to_csv(tmp_path / "a.csv", index=False)
    entry = {"results": "*.csv", "select": {"model": "hnn"}}
    assert reproduce.minutes(entry) == pytest.approx((60 + 90) / 60)


@pytest.mark.parametrize(
    ("name", "said"), [("arm/none", "no entry arm/none"), ("real/lnn", "not published")]
)
def test_an_entry_that_cannot_run_is_refused(calls, name, said):
    assert said in fails("--only", name)
    assert not calls


def test_the_real_programs_leave_what_is_looked_for(tmp_path, monkeypatch):
    def call(command, check):
        run_script(Path(command[1]).name, *command[2:])
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(reproduce, "subprocess", types.SimpleNamespace(run=call))
    entry = {
        "train": [*TINY, NO_FIGURES, "model=mlp", "seed=0"],
        "evaluate": ["horizon=0.1", "windows=[]"],
    }
    reproduce.run("arm/mlp", entry, tmp_path)
    assert reproduce.state("arm/mlp", entry, tmp_path) == "done"
    (table,) = reproduce.tables("arm/mlp", entry, tmp_path)
    assert len(reproduce.selected({"select": {"model": "mlp"}}, [table])) == 1
