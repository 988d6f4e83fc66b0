"""Origin of the numbers of a report."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
import torch
import yaml

from pinn_dyn import __version__
from pinn_dyn.atomic_files import write_whole
from pinn_dyn.data import DataSource, data_identity
from pinn_dyn.data.cache import cache_key
from pinn_dyn.run.configuration.command_line import command_line
from pinn_dyn.run.run import Run

if TYPE_CHECKING:
    from pinn_dyn.evaluation.report.page import Origin


def data_hash(identity: Mapping[str, Any]) -> str:
    """Return a hash of the trajectories of a data set, 16 hexadecimal digits."""
    return cache_key({split: part["hashes"] for split, part in identity.items()})


def provenance() -> dict[str, str]:
    """Return commit, changes since the commit, software and hardware, for records."""
    commit = _git("rev-parse", "--short", "HEAD")
    changed = _git("status", "--porcelain", "--untracked-files=no")
    return {
        "pinn_dyn": __version__,
        "commit": commit or "unknown",
        "uncommitted_changes": "unknown" if not commit else "yes" if changed else "no",
        "torch": str(torch.__version__),
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
    """Write ``provenance.json``, and return the origin of results for a report."""
    from pinn_dyn.evaluation.report.page import Origin  # imports matplotlib

    record = {"command": command_line(), "data_hash": data_hash(data_identity(source))}
    record |= provenance()
    rows = [
        {
            "run": name,
            "model": run.config["model_name"],
            "seed": run.config["seed"],
            "folder": str(run.folder),
            "data hash": data_hash(run.data) if run.data else "unknown",
            "trained on commit": run.metrics.get("commit", "unknown"),
            "trained on": run.metrics.get("hardware", "unknown"),
        }
        for name, run in runs.items()
    ]
    content = json.dumps({"config": config, **beside, "runs": rows, **record}, indent=2)
    write_whole(folder / "provenance.json", content)
    texts = {"this program": config} | {name: run.config for name, run in runs.items()}
    facts = {"data set": source.name} | {k.replace("_", " "): x for k, x in record.items()}
    configurations = {
        f"Configuration of {name}": yaml.safe_dump(value, sort_keys=False, allow_unicode=True)
        for name, value in texts.items()
    }
    return Origin(facts, pd.DataFrame(rows), configurations)


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(Path(__file__).parent), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(x.split(":")[1].strip() for x in lines if x.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
