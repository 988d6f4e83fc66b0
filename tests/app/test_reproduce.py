"""reproduce.py runs entries in order, skips finished parts, and goes on after a failure."""

import subprocess
import types
from pathlib import Path

import pandas as pd
import pytest

import reproduce
from tests.app.entry import NO_FIGURES, TINY, run_script

ENTRIES = {
    "arm/bad": {"train": "bad=1", "evaluate": "", "minutes": 1},
    "arm/lnn": {"train": "seed=0,1", "evaluate": "horizon=5", "minutes": 7},
    "control/lnn": {"runs": ["arm/lnn"], "control": "experiment=x", "minutes": 5},
    "arm/rk4": {"runs": ["arm/lnn"], "train": "loss=x", "evaluate": "", "minutes": 2},
    "arm/beyond": {"runs": ["arm/lnn"], "evaluate": "dataset=x", "minutes": 1},
}


@pytest.fixture
def calls(tmp_path, monkeypatch):
    """Replace the programs by stand-ins that leave the same files; return the called names."""
    names = []

    def run(command, check):
        names.append(Path(command[1]).name)
        words = {
            key: value.strip("'")
            for key, value in (w.split("=", 1) for w in command[2:] if "=" in w)
        }
        if "bad" in words:
            raise subprocess.CalledProcessError(1, command)
        if names[-1] == "train.py":
            for seed in words["seed"].split(","):
                if "loss" in words:
                    assert words["start_from"].endswith(f"-seed{seed}")
                path = Path(words["hydra.sweep.dir"]) / f"{seed}_lnn-seed{seed}" / "metrics.json"
                path.parent.mkdir(parents=True, exist_ok=True)
                if not path.exists():
                    path.write_text("{}")
        else:
            path = Path(words["hydra.run.dir"]) / "summary.csv"
            path.parent.mkdir(parents=True, exist_ok=True)
            label = "controller" if names[-1] == "control.py" else "model"
            pd.DataFrame({label: ["learned"], "error_mean": [0.2]}).to_csv(path, index=False)

    monkeypatch.setattr(reproduce.subprocess, "run", run)
    monkeypatch.setattr(reproduce, "read_entries", lambda: ENTRIES)
    monkeypatch.chdir(tmp_path)
    return names


def test_a_failed_entry_is_listed_and_does_not_stop_the_others(calls):
    with pytest.raises(SystemExit, match="arm/bad failed"):
        reproduce.main([])
    programs = [
        "train",
        "train",
        "evaluate",
        "control",
        "control",
        "train",
        "train",
        "evaluate",
        "evaluate",
    ]
    assert calls == [f"{program}.py" for program in programs]


def test_finished_parts_are_skipped_and_missing_parts_are_made(calls, tmp_path, capsys):
    reproduce.main(["--only", "control/lnn"])  # with the entry that it needs
    assert calls == ["train.py", "evaluate.py", "control.py", "control.py"]
    reproduce.main(["--only", "control/lnn"])
    assert calls[4:] == ["train.py"]  # which checks its configuration
    folder = tmp_path / "runs" / "reproduce"
    (folder / "arm" / "lnn" / "1_lnn-seed1" / "metrics.json").unlink()
    (folder / "control" / "lnn" / "0_lnn-seed0" / "summary.csv").unlink()
    capsys.readouterr()
    reproduce.main(["--list"])
    states = [line.split()[0::3] for line in capsys.readouterr().out.splitlines()]
    assert ["control/lnn", "to"] in states
    assert ["arm/lnn", "done"] in states
    reproduce.main(["--only", "control/lnn"])
    assert calls[5:] == ["train.py", "evaluate.py", "control.py"]


def test_the_comparison_has_new_and_recorded_errors(calls, tmp_path, monkeypatch):
    reproduce.main(["--only", "arm/lnn"])
    index = pd.MultiIndex.from_tuples([("arm", "lnn", 0)], names=["robot", "model", "seed"])
    monkeypatch.setattr(
        reproduce, "recorded", lambda name: pd.DataFrame({"error_mean": [0.3]}, index=index)
    )
    table = reproduce.comparison({"arm/lnn": ENTRIES["arm/lnn"]}, tmp_path / "runs" / "reproduce")
    assert table.loc[("arm/lnn", "lnn")].tolist() == [0.2, 0.3]


@pytest.mark.usefixtures("undrawn")
def test_the_real_programs_write_what_reproduce_looks_for(tmp_path, monkeypatch):
    def run(command, check):
        run_script(Path(command[1]).name, *command[2:])

    monkeypatch.setattr(reproduce, "subprocess", types.SimpleNamespace(run=run))
    words = [word for word in (*TINY, NO_FIGURES) if "'" not in word]
    entry = {
        "train": " ".join([*words, "model=mlp", "seed=0"]),
        "evaluate": "horizon=0.1 'windows=[]'",
    }
    reproduce.run("arm/mlp", entry, tmp_path)
    (table,) = reproduce.summaries("arm/mlp", entry, tmp_path)
    assert {"model", "error_mean"} <= set(pd.read_csv(table))
