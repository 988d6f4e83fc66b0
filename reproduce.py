"""Remake the paper's tables, an entry of results/reproduction.yaml after another.

    python reproduce.py                       all entries; what is finished is not done again
    python reproduce.py --list                the entries, how long each takes, how far each is
    python reproduce.py --only panda/lnn      some entries

Each entry has a folder in runs/reproduce: its trainings and, in evaluation/, their tables. An
interrupted training goes on from its last checkpoint; one whose configuration has changed since is
refused, with the keys that differ. An entry that fails does not stop the others.
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
SUMMARY = "summary.csv"

Entry = dict[str, Any]


class EntryError(Exception):
    """A program of an entry ended with an error, or has nothing to start from."""


def read_entries(path: Path = ENTRIES) -> dict[str, Entry]:
    """The entries by name; results/reproduction.yaml says what is in one."""
    return yaml.safe_load(path.read_text())["entries"]


def recorded(entry: Entry) -> pd.DataFrame:
    """The rows of our results that belong to an entry; none where nothing is recorded."""
    files = sorted(ROOT.glob(entry["results"])) if "results" in entry else []
    return selected(entry, files)


def selected(entry: Entry, files: list[Path]) -> pd.DataFrame:
    """The rows of an entry in tables that evaluate.py or control.py wrote."""
    if not files:
        return pd.DataFrame()
    rows = pd.concat([pd.read_csv(path) for path in files])
    for column, value in entry.get("select", {}).items():
        rows = rows[rows[column] == value]
    return rows


def training_seconds(rows: pd.DataFrame) -> pd.Series:
    """Seconds on a core; wall-clock seconds where the run did not count them."""
    return rows["training_cpu_seconds"].fillna(rows["training_seconds"])


def minutes(entry: Entry) -> float:
    """How long an entry takes on one core."""
    if "minutes" in entry:
        return entry["minutes"]
    rows = recorded(entry)
    return training_seconds(rows).sum() / 60 if len(rows) else 0.0


def tables(name: str, entry: Entry, folder: Path) -> list[Path]:
    """The tables that an entry leaves, one for each run that controls, else one of them all."""
    if "control" not in entry:
        return [folder / name / "evaluation" / SUMMARY]
    runs = trained(folder / entry["run"])
    return [folder / name / run.name / SUMMARY for run in runs]


def trained(folder: Path) -> list[Path]:
    """The finished trainings of an entry."""
    return sorted(path.parent for path in folder.glob("*/metrics.json"))


def state(name: str, entry: Entry, folder: Path) -> str:
    """How far an entry is."""
    if "missing" in entry:
        return "no data"
    written = tables(name, entry, folder)
    if written and all(path.is_file() for path in written):
        return "done"
    return "begun" if (folder / name).exists() else "to do"


def run(name: str, entry: Entry, folder: Path) -> None:
    """Run the programs of an entry.

    Raises:
        EntryError: if one fails.
    """
    if "control" in entry:
        runs = trained(folder / entry["run"])
        if not runs:
            raise EntryError(f"needs {entry['run']}, which has no finished training")
        for path in runs:
            if not (folder / name / path.name / SUMMARY).is_file():
                out = f"hydra.run.dir={folder / name / path.name}"
                call("control.py", *entry["control"], f"run={path}", out)
        return
    # train.py itself passes over what is finished, and goes on with what is not.
    call("train.py", "-m", *entry["train"], f"hydra.sweep.dir={folder / name}")
    (table,) = tables(name, entry, folder)
    newest = max(path.stat().st_mtime for path in (folder / name).glob("*/metrics.json"))
    if not table.is_file() or table.stat().st_mtime < newest:
        found = ",".join(str(path) for path in trained(folder / name))
        out = f"hydra.run.dir={table.parent}"
        call("evaluate.py", f"runs=[{found}]", *entry["evaluate"], out)


def call(program: str, *words: str) -> None:
    """Run an entry script.

    Raises:
        EntryError: if it fails.
    """
    print("$", shlex.join(["python", program, *words]), flush=True)
    ended = subprocess.run([sys.executable, str(ROOT / program), *words], check=False)
    if ended.returncode:
        raise EntryError(f"{program} ended with status {ended.returncode}, its output says why")


def comparison(entries: dict[str, Entry], names: list[str], folder: Path) -> str:
    """What was remade, beside what is recorded and what the paper says."""
    lines = [f"{'entry':<30}{'remade':>12}{'recorded':>12}   paper"]
    for name in names:
        entry = entries[name]
        if "select" not in entry:  # a study: no single figure
            continue
        metric = entry.get("metric", "error_mean")
        files = [path for path in tables(name, entry, folder) if path.is_file()]
        means = [
            f"{rows[metric].mean():.3g}" if len(rows) else "-"
            for rows in (selected(entry, files), recorded(entry))
        ]
        lines.append(f"{name:<30}{means[0]:>12}{means[1]:>12}   {entry.get('paper', '-')}")
    return "\n".join(lines)


def chosen(entries: dict[str, Entry], only: list[str] | None) -> list[str]:
    """The entries to run, those that others need first."""
    if unknown := set(only or []) - set(entries):
        raise SystemExit(f"no entry {', '.join(sorted(unknown))}; --list shows them")
    wanted = only or [name for name, entry in entries.items() if "missing" not in entry]
    if lacking := [name for name in wanted if "missing" in entries[name]]:
        raise SystemExit(f"{', '.join(lacking)}: the paper's log is not published")
    needed = {entries[name]["run"] for name in wanted if "run" in entries[name]}
    return [name for name in entries if name in needed or name in wanted]


def main(arguments: list[str] | None = None) -> None:
    """Run, or list, the entries."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--list", action="store_true", help="show the entries and stop")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these entries, not all")
    parser.add_argument("--folder", type=Path, default=Path("runs/reproduce"))
    parser.add_argument("--entries", type=Path, default=ENTRIES, help="another list of entries")
    given = parser.parse_args(arguments)
    entries, folder = read_entries(given.entries), given.folder
    if given.list:
        for name, entry in entries.items():
            took = "" if "missing" in entry else f"{minutes(entry):.0f} min"
            print(f"{name:<30}{took:>8}   {state(name, entry, folder)}")
    names = chosen(entries, given.only)
    left = [name for name in names if state(name, entries[name], folder) != "done"]
    print(f"{sum(minutes(entries[name]) for name in left):.0f} min to go, on one core")
    if given.list:
        return
    failures = {}
    for number, name in enumerate(names, start=1):
        takes = f"{minutes(entries[name]):.0f} min" if name in left else "done, looking for changes"
        print(f"\n[{number}/{len(names)}] {name}: {takes}", flush=True)
        try:
            run(name, entries[name], folder)
        except EntryError as error:
            failures[name] = str(error)
        except KeyboardInterrupt:
            raise SystemExit("interrupted; the same command goes on") from None
    print(f"\n{comparison(entries, names, folder)}")
    if failures:
        lines = [f"  {name}: {error}" for name, error in failures.items()]
        raise SystemExit("\n".join([f"\n{len(failures)} failed:", *lines]))


if __name__ == "__main__":
    main()
