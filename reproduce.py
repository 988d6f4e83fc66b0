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
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from pydantic import PositiveFloat

from pinn_dyn.app.run_folder import METRICS
from pinn_dyn.app.trust import read_yaml
from pinn_dyn.app.validation import ConfigError, check_value
from pinn_dyn.spelling import did_you_mean

ROOT = Path(__file__).resolve().parent
ENTRIES = ROOT / "results" / "reproduction.yaml"
SUMMARY = "summary.csv"

Entry = dict[str, Any]


@dataclass
class _Keys:
    """Of an entry: what results/reproduction.yaml says of them."""

    train: Sequence[str] = ()
    evaluate: Sequence[str] = ()
    control: Sequence[str] = ()
    runs: Sequence[str] = ()
    results: str = ""
    select: Mapping[str, Any] | None = None
    metric: str = ""
    unit: str = ""
    minutes: PositiveFloat = 1.0
    paper: str = ""
    pairs: int = 0
    steps: int = 0
    missing: str = ""


_WHOLE = (
    {"train", "evaluate"},
    {"evaluate", "runs", "minutes"},
    {"control", "runs", "minutes"},
    {"missing"},
)
"""Keys that an entry needs, of one kind or another."""


class EntryError(Exception):
    """A program of an entry ended with an error, or has nothing to start from."""


def read_entries(path: Path = ENTRIES) -> dict[str, Entry]:
    """The entries by name; results/reproduction.yaml says what is in one.

    Raises:
        ConfigError: on a file that cannot be read, or an entry that cannot be run.
    """
    entries: Any = read_yaml(path).get("entries")
    try:
        check_value("entries", entries, Mapping[str, _Keys | Mapping[str, Any]])
        for name, entry in entries.items():
            _check_entry(name, entry, entries)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return entries


def _check_entry(name: str, entry: Entry, entries: dict[str, Entry]) -> None:
    """Refuse an entry that nothing can be run of, or whose folder would be elsewhere."""
    parts = Path(name).parts if isinstance(name, str) else ()
    if not parts or Path(name).is_absolute() or ".." in parts:
        raise ConfigError(f"entries has {name!r}, expected the name of a folder below --folder")
    if not any(keys <= entry.keys() for keys in _WHOLE):
        raise ConfigError(
            f"entries.{name} has {', '.join(entry) or 'nothing'}, expected train and evaluate, or "
            "evaluate or control with runs and minutes, or missing"
        )
    before = list(entries)[: list(entries).index(name)]
    for one in entry.get("runs", ()):
        if one not in before or "train" not in entries[one]:
            raise ConfigError(
                f"entries.{name}.runs has {one!r}, expected entries above it that train"
            )
    if Path(entry.get("results", "")).is_absolute():
        raise ConfigError(
            f"entries.{name}.results is {entry['results']!r}, expected files below {ROOT}"
        )


def recorded(entry: Entry) -> pd.DataFrame:
    """The rows of our results that belong to an entry; none where nothing is recorded."""
    files = sorted(ROOT.glob(entry["results"])) if "results" in entry else []
    return selected(entry, files)


def selected(entry: Entry, files: list[Path]) -> pd.DataFrame:
    """The rows of an entry in tables that evaluate.py or control.py wrote.

    Raises:
        ConfigError: naming the table that cannot be read, or has no such column.
    """
    found = []
    for path in files:
        try:
            rows = pd.read_csv(path)
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path} cannot be read, delete it and run again: {error}") from error
        for column, value in (entry.get("select") or {}).items():
            if column not in rows:
                raise ConfigError(
                    f"{path} has no column {column!r}, by which its entry selects rows: "
                    f"there are {', '.join(rows)}"
                )
            rows = rows[rows[column].isin(value if isinstance(value, list) else [value])]
        found.append(rows)
    return pd.concat(found) if found else pd.DataFrame()


def training_seconds(rows: pd.DataFrame) -> pd.Series:
    """Seconds on a core; wall-clock seconds where the run did not count them.

    Raises:
        ConfigError: if the tables do not have them.
    """
    if not {"training_cpu_seconds", "training_seconds"} <= {*rows}:
        raise ConfigError(
            "the tables of an entry have no columns training_cpu_seconds and training_seconds, "
            f"there are {', '.join(rows)}: give results that evaluate.py wrote, or minutes"
        )
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
    runs = trained_of(entry, folder)
    return [folder / name / run.name / SUMMARY for run in runs]


def trained(folder: Path) -> list[Path]:
    """The finished trainings of an entry."""
    return sorted(path.parent for path in folder.glob(f"*/{METRICS}"))


def trained_of(entry: Entry, folder: Path) -> list[Path]:
    """The finished trainings that an entry starts from."""
    return [path for one in entry.get("runs", ()) for path in trained(folder / one)]


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
    for one in entry.get("runs", ()):
        if not trained(folder / one):
            raise EntryError(f"needs {one}, which has no finished training")
    runs = trained_of(entry, folder)
    if "control" in entry:
        for path in runs:
            if not (folder / name / path.name / SUMMARY).is_file():
                out = f"hydra.run.dir={quoted(folder / name / path.name)}"
                call("control.py", *entry["control"], f"run={quoted(path)}", out)
        return
    if "train" in entry:
        starts = [
            [f"seed={read_yaml(path / METRICS)['seed']}", f"start_from={quoted(path)}"]
            for path in runs
        ]
        # train.py itself passes over what is finished, and goes on with what is not.
        for start in starts or [[]]:
            sweep = f"hydra.sweep.dir={quoted(folder / name)}"
            call("train.py", "-m", *entry["train"], *start, sweep)
        runs = trained(folder / name)
        if not runs:
            raise EntryError("train.py left no finished training")
    (table,) = tables(name, entry, folder)
    newest = max((path / METRICS).stat().st_mtime for path in runs)
    if not table.is_file() or table.stat().st_mtime < newest:
        found = ",".join(quoted(path) for path in runs)
        out = f"hydra.run.dir={quoted(table.parent)}"
        call("evaluate.py", f"runs=[{found}]", *entry["evaluate"], out)


def quoted(path: Path) -> str:
    """A path as a value of an override, whatever characters it has."""
    text = str(path)
    if re.fullmatch(r"[\w./-]+", text, re.ASCII):
        return text
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


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
    lines = [f"{'entry':<42}{'remade':>12}{'recorded':>12}   paper"]
    for name in names:
        entry = entries[name]
        metric = entry.get("metric", "error_mean")
        files = [path for path in tables(name, entry, folder) if path.is_file()]
        both = [selected(entry, files), recorded(entry)]
        models = both[1]["model"].unique() if "model" in both[1] else []
        # A line for each of several models, with the mean over its runs.
        for model in models if len(models) > 1 else [None]:
            means = []
            for data in both:
                rows = data[data["model"] == model] if model and len(data) else data
                found = len(rows) and metric in rows
                means.append(f"{rows[metric].mean():.3g}" if found else "-")
            label = f"{name} {model}" if model else name
            lines.append(f"{label:<42}{means[0]:>12}{means[1]:>12}   {entry.get('paper', '-')}")
    return "\n".join(lines)


def chosen(entries: dict[str, Entry], only: list[str] | None) -> list[str]:
    """The entries to run, those that others need first."""
    if unknown := set(only or []) - set(entries):
        hint = did_you_mean(min(unknown), entries) or "; --list shows them"
        raise SystemExit(f"no entry {', '.join(sorted(unknown))}{hint}")
    wanted = only or [name for name, entry in entries.items() if "missing" not in entry]
    if lacking := [name for name in wanted if "missing" in entries[name]]:
        raise SystemExit(f"{', '.join(lacking)}: the paper's log is not published")
    needed = set(wanted)
    for name in reversed(entries):  # what an entry needs stands above it
        if name in needed:
            needed.update(entries[name].get("runs", ()))
    return [name for name in entries if name in needed]


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
    try:
        _remake(read_entries(given.entries), given.folder, given.only, listed=given.list)
    except ConfigError as error:
        raise SystemExit(f"Error: {error}") from error


def _remake(
    entries: dict[str, Entry], folder: Path, only: list[str] | None, *, listed: bool
) -> None:
    if listed:
        for name, entry in entries.items():
            took = "" if "missing" in entry else f"{minutes(entry):.0f} min"
            print(f"{name:<42}{took:>8}   {state(name, entry, folder)}")
    names = chosen(entries, only)
    left = [name for name in names if state(name, entries[name], folder) != "done"]
    print(f"{sum(minutes(entries[name]) for name in left):.0f} min to go, on one core")
    if listed:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise ConfigError(f"--folder is {folder}, which cannot be written to: {error}") from error
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
