"""Parquet files, those of a LeRobot data set (version 3) among them, as tables.

A column of vectors becomes ``name_1``, ``name_2`` and so on, or, where ``meta/info.json`` above the
file names its entries, ``name/entry``, as ``observation.state/shoulder_pan.pos``.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pinn_dyn.data.logs.bags import optional
from pinn_dyn.data.logs.errors import LogError, shown


def read_parquet(path: Path) -> pd.DataFrame:
    """All columns of numbers and texts; the index is the row.

    Raises:
        LogError: if it cannot be read or is empty.
    """
    arrow = optional("pyarrow", path)
    parquet = optional("pyarrow.parquet", path)
    try:
        content = parquet.read_table(path)
    except (OSError, arrow.ArrowException) as error:
        raise LogError(
            f"{path}: cannot be read as Parquet, it may be cut short: {error}"
        ) from error
    if not content.num_rows:
        raise LogError(f"{path}: has no rows")
    entries = _entries(path)
    columns: dict[str, Any] = {}
    unusable: dict[str, str] = {}
    for name in content.column_names:
        column = content.column(name)
        kind = column.type
        lists = (
            arrow.types.is_list(kind)
            or arrow.types.is_large_list(kind)
            or arrow.types.is_fixed_size_list(kind)
        )
        if not lists:
            columns[name] = column.to_pandas().to_numpy()
            continue
        rows = column.to_pylist()
        if any(row is None for row in rows) or len({len(row) for row in rows}) != 1:
            unusable[name] = "has rows of different lengths"
            continue
        values = np.array(rows)
        if values.ndim != 2 or values.dtype.kind not in "fiub":
            unusable[name] = f"has entries of the type {kind.value_type}"
            continue
        given = entries.get(name, [])
        for k in range(values.shape[1]):
            own = f"{name}/{given[k]}" if len(given) == values.shape[1] else f"{name}_{k + 1}"
            columns[own] = values[:, k]
    table = pd.DataFrame(columns, index=pd.RangeIndex(1, content.num_rows + 1))
    table.attrs["unusable"] = unusable
    return table


def _entries(path: Path) -> dict[str, Sequence[str]]:
    """Names of the entries of vectors, from the description of a LeRobot data set."""
    infos = [folder / "meta" / "info.json" for folder in path.absolute().parents]
    info = next((file for file in infos if file.is_file()), None)
    if info is None:
        return {}
    try:
        features = json.loads(info.read_text())["features"]
        given = {name: feature.get("names") for name, feature in features.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        said = shown(error)
        raise LogError(f"{info}: is no description of a LeRobot data set: {said}") from error
    found: dict[str, Sequence[str]] = {}
    for name, names in given.items():
        # Version 2 has them one level deeper, as {"motors": [...]}.
        if isinstance(names, dict) and len(names) == 1:
            names = next(iter(names.values()))
        if isinstance(names, list):
            found[name] = [str(entry) for entry in names]
    return found
