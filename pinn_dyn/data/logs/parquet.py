"""Parquet files, those of a LeRobot data set (version 3) among them.

A column of vectors becomes ``name_1``, ``name_2`` and so on, or, where ``meta/info.json`` above the
file names its entries, ``name/entry``, as ``observation.state/shoulder_pan.pos``.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd

from pinn_dyn.data.logs.table import Request, optional


def read_parquet(path: Path, request: Request) -> pd.DataFrame:
    """Read a Parquet file; the index is the number of the row."""
    optional("pyarrow", path)
    content = pd.read_parquet(path, engine="pyarrow")
    entries = _entries(path)
    columns: dict[str, np.ndarray] = {}
    for name, column in content.items():
        if column.dtype != object or not isinstance(column.iloc[0], np.ndarray):
            columns[str(name)] = column.to_numpy()
        elif column.map(np.size).nunique() == 1:
            values = np.stack(column.to_list())
            names = entries.get(str(name), [])
            for k in range(values.shape[1]):
                named = len(names) == values.shape[1]
                columns[f"{name}/{names[k]}" if named else f"{name}_{k + 1}"] = values[:, k]
    return pd.DataFrame(columns, index=pd.RangeIndex(1, len(content) + 1))


def _entries(path: Path) -> dict[str, list[str]]:
    """Return the names of the entries of vectors, from the description of a LeRobot data set."""
    infos = [folder / "meta" / "info.json" for folder in path.absolute().parents]
    info = next((file for file in infos if file.is_file()), None)
    entries = {}
    features = json.loads(info.read_text()).get("features", {}) if info else {}
    for key, feature in features.items():
        names = feature.get("names")
        # Version 2 has them one level deeper, as {"motors": [...]}.
        if isinstance(names, dict) and len(names) == 1:
            names = next(iter(names.values()))
        if isinstance(names, list):
            entries[key] = names
    return entries
