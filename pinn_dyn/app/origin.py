"""Where the numbers of a report come from: command, commit, data, runs and configurations."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from pinn_dyn.app.runs import Run
from pinn_dyn.data import DataSource
from pinn_dyn.data.cache import cache_key
from pinn_dyn.evaluation.report import Origin


def command_line() -> str:
    """The command that this process was started with, to be pasted into a shell."""
    program = Path(sys.argv[0]).name
    start = ["python", program] if program.endswith(".py") else [program]
    return shlex.join([*start, *sys.argv[1:]])


def data_hash(source: DataSource) -> str:
    """What tells one data set from another: 16 hexadecimal digits of its fingerprint."""
    return cache_key(source.fingerprint())


def build_origin(
    runs: Mapping[str, Run], source: DataSource, record: Mapping[str, str], config: dict[str, Any]
) -> Origin:
    """The last section of a report.

    Args:
        runs: names of the runs as they are in the tables.
        source: the data that they share.
        record: what :func:`pinn_dyn.app.runs.provenance` and :func:`command_line` say.
        config: the resolved configuration of this program.
    """
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
