"""Run the entries of results/reproduction.yaml, which made the tables of the documentation.

    python reproduce.py                       all entries
    python reproduce.py --list                names, duration and state of the entries
    python reproduce.py --only panda/lnn      some entries, with the entries that they need

The runs of an entry are in runs/reproduce/<entry>. A second call skips finished parts and resumes
interrupted trainings. An entry that fails does not stop the others.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

ROOT = Path(__file__).resolve().parent
ENTRIES = ROOT / "results" / "reproduction.yaml"
RESULTS = ROOT / "results" / "results.csv"
COMMAND = "python reproduce.py --only "  # begins the column "command" of an entry's results

Entry = dict[str, Any]


def read_entries() -> dict[str, Entry]:
    """Return the entries by name; the file itself describes their keys."""
    return yaml.safe_load(ENTRIES.read_text(encoding="utf-8"))["entries"]


def recorded(name: str) -> pd.DataFrame:
    """Return the recorded results of an entry: one row per run, one column per metric."""
    data = pd.read_csv(RESULTS)
    data = data[data["command"] == COMMAND + name].fillna({"seed": 0})
    return data.pivot(index=["robot", "model", "seed"], columns="metric", values="value")


def minutes(name: str, entry: Entry) -> float:
    """Return the duration of an entry on one core."""
    seconds = recorded(name).get("training_seconds", pd.Series(dtype=float)).sum()
    return entry.get("minutes", seconds / 60)


def trained(folder: Path) -> list[Path]:
    """Return the folders of finished trainings in ``folder``."""
    return sorted(path.parent for path in folder.glob("*/metrics.json"))


def start_runs(entry: Entry, folder: Path) -> list[Path]:
    """Return the finished trainings that an entry evaluates, controls with or starts from."""
    return [path for name in entry.get("runs", ()) for path in trained(folder / name)]


def summaries(name: str, entry: Entry, folder: Path) -> list[Path]:
    """Return the paths of the tables that an entry writes."""
    runs = [path.name for path in start_runs(entry, folder)] if "control" in entry else []
    return [folder / name / part / "summary.csv" for part in runs or ["evaluation"]]


def run(name: str, entry: Entry, folder: Path) -> None:
    """Run the programs of an entry.

    Raises:
        subprocess.CalledProcessError: if a program fails.
        FileNotFoundError: if an entry that this entry needs has no finished training.
    """
    runs = start_runs(entry, folder)
    if "runs" in entry and not runs:
        raise FileNotFoundError(f"no finished training of {', '.join(entry['runs'])}")
    if "control" in entry:
        for path in runs:
            target = folder / name / path.name
            if not (target / "summary.csv").is_file():
                call("control.py", entry["control"], f"run='{path}'", f"hydra.run.dir='{target}'")
        return
    if "train" in entry:
        commands = entry["train"] if isinstance(entry["train"], list) else [entry["train"]]
        # A run folder is named <number>_<model>-seed<seed>.
        starts = [[f"seed={x.name.split('-seed')[1]}", f"start_from='{x}'"] for x in runs] or [[]]
        for command in commands:
            for start in starts:  # train.py skips finished trainings and resumes the others
                call("train.py", f"-m {command}", *start, f"hydra.sweep.dir='{folder / name}'")
        runs = trained(folder / name)
    (table,) = summaries(name, entry, folder)
    newest = max((path / "metrics.json").stat().st_mtime for path in runs)
    if not table.is_file() or table.stat().st_mtime < newest:
        paths = ",".join(f"'{path}'" for path in runs)
        call("evaluate.py", entry["evaluate"], f"runs=[{paths}]", f"hydra.run.dir='{table.parent}'")


def call(program: str, overrides: str, *more: str) -> None:
    """Print and run a command of this folder."""
    words = [*shlex.split(overrides), *more]
    print("$", shlex.join(["python", program, *words]), flush=True)
    subprocess.run([sys.executable, str(ROOT / program), *words], check=True)


def comparison(entries: dict[str, Entry], folder: Path) -> pd.DataFrame:
    """Return new and recorded errors of each entry, means over the seeds."""
    errors = {}
    for name, entry in entries.items():
        metric = entry.get("metric", "error_mean")
        old = recorded(name).reindex(columns=[metric]).dropna().reset_index()
        if "control" in entry:
            old = old[old["model"].str.endswith("learned")].assign(model="learned")
        tables = [pd.read_csv(path) for path in summaries(name, entry, folder) if path.is_file()]
        new = pd.concat(tables or [pd.DataFrame(columns=["model", "seed", metric])])
        if "ensemble=true" in entry.get("evaluate", ""):
            new = new[new["model"].str.startswith("mean of")]
        new = new.rename(columns={"controller": "model"}).dropna(subset=set(new) & {"seed"})
        if "control" not in entry and old["model"].nunique() == 1:  # laws keep their names
            new = new.assign(model=old["model"].iloc[0])
        means = (table.groupby("model")[metric].mean() for table in (new, old))
        errors[name] = pd.concat(means, axis=1, keys=["new", "recorded"])
    return pd.concat(errors, names=["entry"])


def selected(entries: dict[str, Entry], only: list[str] | None) -> dict[str, Entry]:
    """Return the entries named in ``only``, or all, with the entries that they need."""
    if unknown := set(only or ()) - set(entries):
        raise SystemExit(f"no entry {', '.join(sorted(unknown))}; --list shows the entries")
    names = set(only or entries)
    for name in reversed(entries):  # needed entries come first in the file
        if name in names:
            names.update(entries[name].get("runs", ()))
    return {name: entry for name, entry in entries.items() if name in names}


def main(arguments: list[str] | None = None) -> None:
    """Run or list the entries."""
    parser = argparse.ArgumentParser(description="Run the entries of results/reproduction.yaml.")
    parser.add_argument("--list", action="store_true", help="list the entries and stop")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="names of entries to run")
    parser.add_argument("--folder", type=Path, default=Path("runs/reproduce"), help="of the runs")
    options = parser.parse_args(arguments)
    entries = selected(read_entries(), options.only)
    tables = {name: summaries(name, entry, options.folder) for name, entry in entries.items()}
    todo = [name for name, paths in tables.items() if not all(path.is_file() for path in paths)]
    if options.list:
        for name, entry in entries.items():
            state = "to do" if name in todo else "done"
            print(f"{name:<42}{minutes(name, entry):>8.0f} min   {state}")
        return
    print(f"{sum(minutes(name, entries[name]) for name in todo):.0f} min to go, on one core")
    failures = {}
    for name, entry in entries.items():
        print(f"\n{name}", flush=True)
        try:
            run(name, entry, options.folder)
        except (subprocess.CalledProcessError, FileNotFoundError) as error:
            failures[name] = error
    print(f"\n{comparison(entries, options.folder).to_string(na_rep='-')}")
    if failures:
        raise SystemExit("\n".join(f"{name} failed: {error}" for name, error in failures.items()))


if __name__ == "__main__":
    main()
