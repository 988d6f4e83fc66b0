"""Parquet files, those of a LeRobot data set (version 3) among them.

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

from pinn_dyn.data.logs.readers import Request, optional
from pinn_dyn.data.logs.table import Table


def read_parquet(path: Path, request: Request) -> Table:
    """Read a Parquet file; the index is the number of the row."""
    optional("pyarrow", path)
    content = pd.read_parquet(path, engine="pyarrow").reset_index(drop=True)
    entries = _entries(path)
    columns: dict[str, Any] = {}
    unusable: dict[str, str] = {}
    for name, column in content.items():
        key = str(name)
        if column.dtype != object or not isinstance(column.iloc[0], np.ndarray):
            columns[key] = column.to_numpy()
            continue
        try:
            values = np.stack(column.to_list())
        except (ValueError, TypeError):
            unusable[key] = "has rows of different lengths"
            continue
        names = entries.get(key, [])
        if len(names) != values.shape[1]:
            names = []
        for k in range(values.shape[1]):
            columns[f"{key}/{names[k]}" if names else f"{key}_{k + 1}"] = values[:, k]
    frame = pd.DataFrame(columns, index=pd.RangeIndex(1, len(content) + 1))
    return Table(frame, str(path), unusable=unusable)


def _entries(path: Path) -> dict[str, Sequence[str]]:
    """Return the names of the entries of vectors, from the description of a LeRobot data set."""
    infos = (folder / "meta" / "info.json" for folder in path.absolute().parents)
    info = next((file for file in infos if file.is_file()), None)
    features = {} if info is None else json.loads(info.read_text()).get("features", {})
    entries: dict[str, Sequence[str]] = {}
    for key, feature in features.items():
        names = feature.get("names")
        # Version 2 has them one level deeper, as {"motors": [...]}.
        if isinstance(names, dict) and len(names) == 1:
            names = next(iter(names.values()))
        if isinstance(names, list):
            entries[key] = [str(entry) for entry in names]
    return entries
