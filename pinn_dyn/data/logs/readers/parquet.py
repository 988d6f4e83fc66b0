"""Read Parquet files as tables, including data sets of LeRobot.

Entries of a vector are ``action_1``, ``action_2`` and so on. With LeRobot, they also have the names
in ``meta/info.json``, ``action/shoulder``. Fields of a struct are ``state.q``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.table import Request, optional, vector_columns


def read_parquet(path: Path, request: Request) -> pd.DataFrame:
    """Read a Parquet file. The index of a data frame is a column.

    Raises:
        LogError: if LeRobot's names of a vector are requested and do not match its length.
    """
    content = optional("pyarrow.parquet", path).ParquetFile(path).read()
    while any(str(kind).startswith("struct") for kind in content.schema.types):
        content = content.flatten()
    columns: dict[str, Any] = {}
    labels = _labels(path)
    for name, column in content.to_pandas(ignore_metadata=True).items():
        rows = np.flatnonzero(column.notna())
        if not len(rows) or not isinstance(column.iloc[rows[0]], np.ndarray):
            columns[str(name)] = column
            continue
        cells = column.map(lambda x: np.concatenate(x) if x.dtype == object else x, "ignore")
        vectors = vector_columns(str(name), cells)
        columns |= vectors
        names = [f"{name}/{label}" for label in labels.get(str(name), [])]
        if len(names) == len(vectors):
            columns |= dict(zip(names, vectors.values(), strict=True))
        elif {*names} & {*request.columns}:
            raise LogError(
                f"{path}: meta/info.json has {len(names)} names of {name!r}, which has "
                f"{len(vectors)} entries: write their numbers, {name}_1 to {name}_{len(vectors)}; "
                f"the names are {listed(names)}"
            )
    return pd.DataFrame(columns).set_axis(pd.RangeIndex(1, len(content) + 1))


def _labels(path: Path) -> dict[str, list[str]]:
    """Return LeRobot's names of the entries of each vector."""
    info = next(
        (x / "meta/info.json" for x in path.parents if (x / "meta/info.json").is_file()), None
    )
    if info is None:
        return {}
    features = json.loads(info.read_text()).get("features", {})
    return {name: list(_texts(feature.get("names"))) for name, feature in features.items()}


def _texts(names: Any) -> Iterator[str]:
    """Return the texts of lists and mappings in their order, such as ``{motors: [...]}``."""
    if isinstance(names, str):
        yield names
    elif names:
        for item in names:
            entry = names[item] if isinstance(names, dict) else item
            yield from _texts(item if isinstance(entry, int) else entry)
