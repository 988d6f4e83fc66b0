"""Which run folders are meant, and what became of their trainings."""

from __future__ import annotations

import glob
import logging
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.run_folder import CHECKPOINTS, CONFIG, METRICS, read_metrics
from pinn_dyn.app.sweep import ERROR, first_line
from pinn_dyn.app.trust import read_yaml
from pinn_dyn.evaluation.sweep_table import Cell, flatten
from pinn_dyn.spelling import did_you_mean

MANY_FOLDERS = 2_000
MOST_FOLDERS = 50_000
"""Looked through below a place; a large sweep has some thousand."""

log = logging.getLogger(__name__)

_HYDRA_CONFIG = Path(".hydra") / "config.yaml"


@dataclass(frozen=True)
class Job:
    """A folder that train.py wrote, whatever became of the training.

    Attributes:
        folder: the run folder.
        config: its flattened configuration, as far as it is known.
        derived: keys that the configuration computes from others.
        record: what metrics.json holds; None if the training did not get there.
        problem: why there is no record.
    """

    folder: Path
    config: dict[str, Cell]
    derived: frozenset[str]
    record: dict[str, Any] | None
    problem: str


def find_runs(patterns: list[str] | str) -> list[Path]:
    """Run folders that match paths or globs; folders without a config are passed over in globs.

    Raises:
        ConfigError: if a pattern matches nothing, or a plain path is no run folder.
    """
    found: dict[Path, Path] = {}  # a run that is linked, or named in two ways, is one
    for pattern, matches in _matched(patterns):
        folders = [p for p in matches if (p / CONFIG).is_file()]
        if not folders:
            what = "matches nothing" if not matches else f"matches no run folder (no {CONFIG})"
            raise ConfigError(f"runs: '{pattern}' {what}; give folders that train.py wrote")
        for p in folders:
            found.setdefault(p.resolve(), p)
    return list(found.values())


def _matched(patterns: list[str] | str) -> Iterator[tuple[str, list[Path]]]:
    """Each path or glob, and what it matches.

    Raises:
        ConfigError: if there is none.
    """
    if not patterns:
        raise ConfigError("runs is empty, expected run folders or globs, as runs=[runs/my_arm/*]")
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        matches = sorted(Path(p) for p in glob.glob(os.path.expanduser(pattern)))
        if pattern and not matches and Path(pattern).is_dir():  # a name with [ or * in it
            matches = [Path(pattern)]
        yield pattern, matches


def find_jobs(patterns: list[str] | str) -> list[Job]:
    """Jobs of train.py in folders, or below them; in the order in which they finished.

    Raises:
        ConfigError: if a pattern leads to no job.
    """
    found: dict[Path, Job] = {}
    for pattern, places in _matched(patterns):
        below = {
            path.parent.parent if path.parent.name == ".hydra" else path.parent
            for place in places
            for path in _configs_below(place, pattern)
        }
        jobs = [job for job in map(_read_job, sorted(below, key=_natural)) if job is not None]
        if not jobs:
            what = "leads to no run" if places else "matches nothing"
            raise ConfigError(f"runs: '{pattern}' {what}; give folders that train.py wrote")
        found |= {job.folder: job for job in jobs}
    return sorted(found.values(), key=lambda job: _finished_at(job.folder))


def _read_job(folder: Path) -> Job | None:
    """A folder as a job; None if something else than a training wrote it."""
    resolved, raw = _read_yaml(folder / CONFIG), _read_yaml(folder / _HYDRA_CONFIG)
    # A job that found no use for its configuration has not written it in full.
    if "trainer" not in {**raw, **resolved}:
        return None
    values = flatten(raw)
    derived = frozenset(key for key, value in values.items() if "${" in str(value))
    config = flatten(resolved) or {k: v for k, v in values.items() if k not in derived}
    # Also where a run has been copied without its .hydra folder.
    derived |= {k for k, v in config.items() if k.endswith(".seed") and v == config.get("seed")}
    record, problem = None, ""
    try:
        record = read_metrics(folder)
    except ConfigError:
        problem = f"failed: {METRICS} cannot be read, it may be cut short"
    else:
        if record is None:
            problem = _last_words(folder)
        elif not resolved or not isinstance(config.get("seed"), int):
            record, problem = None, f"failed: {CONFIG} cannot be read"
        elif record.get("seed", config["seed"]) != config["seed"]:
            problem = f"failed: {METRICS} is of seed {record['seed']}, {CONFIG} of another one"
            record = None
    return Job(folder, config, derived, record, problem)


def _configs_below(place: Path, pattern: str) -> Iterator[Path]:
    """Configurations in a folder and below it.

    Raises:
        ConfigError: if there are so many folders that these can hardly be runs alone.
    """
    for count, (folder, below, files) in enumerate(os.walk(place)):
        if count == MANY_FOLDERS:
            log.warning("runs: looking through all folders below %s", place)
        if count == MOST_FOLDERS:
            raise ConfigError(
                f"runs: '{pattern}' has more than {MOST_FOLDERS} folders below it, expected run "
                "folders or a folder of them, as runs=[runs/soft_arm_1]"
            )
        if CONFIG in files:
            yield Path(folder, CONFIG)
        below[:] = [name for name in below if name not in (CHECKPOINTS, "tensorboard")]


def _read_yaml(path: Path) -> dict[str, Any]:
    """A configuration; empty if it is missing or damaged."""
    try:
        return read_yaml(path)
    except ConfigError:
        return {}


def _last_words(folder: Path) -> str:
    """How a job without a record ended: its error, or else the last line of its log."""
    if (folder / ERROR).is_file():
        return f"failed: {first_line(folder / ERROR)}"
    lines = []
    for path in sorted(folder.glob("*.log")):
        lines += [line for line in path.read_text(errors="replace").splitlines() if line.strip()]
    if not lines:
        return "running or stopped, without a log"
    last = re.sub(r"^(\[[^]]*\])+ - ", "", lines[-1])  # without date, module and level
    return f"running or stopped, its log ends with: {last}"


def _natural(folder: Path) -> list[tuple[int, str]]:
    """Order of folders by name in which 2_lnn comes before 10_lnn."""
    return [(int(n or 0), text) for n, text in re.findall(r"(\d*)(\D*)", str(folder))]


def _finished_at(folder: Path) -> float:
    path = folder / METRICS
    return path.stat().st_mtime if path.is_file() else math.inf


def filter_jobs(jobs: list[Job], conditions: dict[str, Any]) -> list[Job]:
    """The jobs that meet all conditions; a list of values means any of them.

    Raises:
        ConfigError: if no job has a key, or none is left.
    """
    known = sorted({key for job in jobs for key in job.config})
    for key, value in conditions.items():
        if key not in known:
            hint = did_you_mean(key, known)
            raise ConfigError(f"filter: the runs have no key '{key}'{hint}")
        values = value if isinstance(value, list) else [value]
        if any(isinstance(one, (dict, list)) for one in values):
            raise ConfigError(f"filter: {key} is {value}, expected a value, or a list of values")
        wanted = [flatten({key: one})[key] for one in values]
        # What an early failure did not write down is no reason to hide it.
        left = [
            job
            for job in jobs
            if job.config.get(key) in wanted or (job.record is None and key not in job.config)
        ]
        if not left:
            found = sorted({str(job.config[key]) for job in jobs if key in job.config})
            raise ConfigError(f"filter: no run has {key}={value}; there are {', '.join(found)}")
        jobs = left
    return jobs


def derived_keys(jobs: list[Job]) -> set[str]:
    """Keys that follow from others in every run that has them."""
    keys = {key for job in jobs for key in job.derived}
    return {key for key in keys if all(key in j.derived or key not in j.config for j in jobs)}
