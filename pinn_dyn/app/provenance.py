"""Where the numbers of a report come from: command, commit, data, runs and configurations."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import torch
import yaml

from pinn_dyn import __version__
from pinn_dyn.app.run_folder import Run, write_json
from pinn_dyn.app.words import command_line
from pinn_dyn.data import DataSource
from pinn_dyn.data.cache import cache_key
from pinn_dyn.evaluation.report import Origin


def data_hash(source: DataSource) -> str:
    """What tells one data set from another: 16 hexadecimal digits of its fingerprint."""
    return cache_key(source.fingerprint())


def provenance() -> dict[str, str]:
    """Commit, whether tracked files differ from it, software and hardware, for the records."""
    commit = _git("rev-parse", "--short", "HEAD")
    changed = _git("status", "--porcelain", "--untracked-files=no")
    return {
        "pinn_dyn": __version__,
        "commit": commit or "unknown",
        "uncommitted_changes": "unknown" if not commit else "yes" if changed else "no",
        "torch": torch.__version__,
        "python": platform.python_version(),
        "hardware": f"{_processor()}, {os.cpu_count()} cores, {torch.get_num_threads()} threads",
    }


def write_provenance(
    runs: Mapping[str, Run],
    source: DataSource,
    config: dict[str, Any],
    beside: dict[str, Any],
    folder: Path,
) -> Origin:
    """Write ``provenance.json``; returns the same as the last section of a report.

    Args:
        runs: names of the runs as they are in the tables.
        source: the data that they share.
        config: the resolved configuration of this program.
        beside: what the file has beside that configuration.
        folder: where it is written.
    """
    record = {"command": command_line(), "data_hash": data_hash(source), **provenance()}
    write_json(folder / "provenance.json", {"config": config, **beside, **record})
    rows = [
        {
            "run": name,
            "model": run.config["model_name"],
            "seed": run.config["seed"],
            "folder": str(run.folder),
            "trained on commit": run.metrics.get("commit", "unknown"),
            "trained on": run.metrics.get("hardware", "unknown"),
        }
        for name, run in runs.items()
    ]
    configurations = {"Configuration of this program": _text(config)}
    configurations |= {f"Configuration of {name}": _text(run.config) for name, run in runs.items()}
    changed = {"yes": ", with uncommitted changes", "no": ""}
    facts = {"data set": source.name} | {
        name.replace("_", " "): value
        for name, value in record.items()
        if name != "uncommitted_changes"
    }
    facts["commit"] += changed.get(record["uncommitted_changes"], "")
    return Origin(facts, pd.DataFrame(rows), configurations)


def _text(config: dict[str, Any]) -> str:
    return yaml.safe_dump(config, sort_keys=False, allow_unicode=True)


def _git(*arguments: str) -> str:
    """What git says of the code; nothing where there is no repository."""
    command = ["git", "-C", str(Path(__file__).parent), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(x.split(":")[1].strip() for x in lines if x.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
