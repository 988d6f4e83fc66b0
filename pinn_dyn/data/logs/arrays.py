"""Files of named arrays as tables: MATLAB, HDF5, NPZ and Parquet.

An array with as many rows as the time is a column; a matrix is the columns ``name_1``, ``name_2``
and so on. Fields of structs and groups are joined: ``log.q`` in MATLAB, ``log/q`` in HDF5. Groups
that are runs have the columns ``data/*/q``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.table import Request, optional
from pinn_dyn.spelling import did_you_mean


def read_mat(path: Path, request: Request) -> pd.DataFrame:
    """Read a MATLAB file; the fields of a struct are ``name.field``."""
    h5py = optional("h5py", path)
    if h5py.is_hdf5(path):  # version 7.3
        with h5py.File(path, "r") as file:
            _refuse(path, _visited(h5py, file)[1])
    content = optional("pymatreader", path).read_mat(str(path))
    variables: dict[str, Any] = {}

    def visit(prefix: str, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            if isinstance(value, Mapping):
                visit(f"{prefix}{name}.", value)
            else:
                variables[f"{prefix}{name}"] = value

    visit("", content)
    return _table(path, request.time, variables)


def read_hdf5(path: Path, request: Request) -> dict[str, pd.DataFrame]:
    """Read an HDF5 file. Data sets that lie in other files are not opened."""
    h5py = optional("h5py", path)
    with h5py.File(path, "r") as file:
        names, outside = _visited(h5py, file)
        _refuse(path, [x for x in outside if any(y.startswith(x) for y in request.columns)])
        variables = {name: file[name][()] for name in names}
    runs = _runs(variables, request.columns)
    return {run: _table(path, request.time, values) for run, values in runs.items()}


def _runs(variables: Mapping[str, Any], columns: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the variables of each run, the text that stands for the ``*`` of the columns."""
    before = next((x.split("*")[0] for x in columns if "*" in x), None)
    if before is None:
        return {"": dict(variables)}
    runs: dict[str, dict[str, Any]] = {}
    for name, value in variables.items():
        run, _, field = name.removeprefix(before).partition("/")
        if name.startswith(before) and field:
            runs.setdefault(run, {})[f"{before}*/{field}"] = value
    return dict(sorted(runs.items(), key=lambda x: [len(x[0]), x[0]]))


def _visited(h5py: Any, file: Any) -> tuple[list[str], list[str]]:
    """Return the names of plain data sets, and of links and data sets with values elsewhere."""
    plain: list[str] = []
    outside: list[str] = []

    def link(name: str, item: Any) -> None:
        if isinstance(item, h5py.ExternalLink):
            outside.append(name)

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            (outside if item.external or item.is_virtual else plain).append(name)

    file.visititems_links(link)
    file.visititems(visit)
    return plain, outside


def _refuse(path: Path, outside: list[str]) -> None:
    if outside:
        raise LogError(
            f"{path}: {listed(outside)}: values of other files or virtual data sets are not read, "
            "expected plain data sets: copy the values into the file"
        )


def read_npz(path: Path, request: Request) -> pd.DataFrame:
    """Read an NPZ file. One with Python objects is refused, never unpickled."""
    with np.load(path, allow_pickle=False) as file:
        return _table(path, request.time, file)


def read_parquet(path: Path, request: Request) -> pd.DataFrame:
    """Read a Parquet file, such as one of LeRobot; a column of vectors is a matrix."""
    optional("pyarrow", path)
    content = pd.read_parquet(path, engine="pyarrow")
    columns: dict[str, Any] = {}
    for name, column in content.items():
        if column.dtype != object or not isinstance(column.iloc[0], np.ndarray):
            columns[str(name)] = column.to_numpy()
        elif column.map(np.size).nunique() == 1:
            vectors = np.stack(column.to_list()).T
            columns |= {f"{name}_{k}": values for k, values in enumerate(vectors, start=1)}
    return pd.DataFrame(columns, index=pd.RangeIndex(1, len(content) + 1))


def _table(path: Path, time: str, variables: Mapping[str, Any]) -> pd.DataFrame:
    """Return the real vectors and matrices that have as many rows or columns as the time."""
    arrays = {}
    for name, value in variables.items():
        if isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.ndim in (1, 2):
            arrays[name] = value if value.ndim == 2 else value[:, None]
    if time not in arrays:
        hint = did_you_mean(time, arrays) or "."
        sizes = listed(f"{name} {value.shape}" for name, value in sorted(arrays.items()))
        raise LogError(f"{path}: no variable {time!r} for the time{hint} The file has {sizes}")
    samples = arrays[time].size
    columns: dict[str, np.ndarray] = {}
    for name, value in arrays.items():
        rows = value if value.shape[0] == samples else value.T
        if rows.shape[0] != samples:  # parameters and the like
            continue
        width = rows.shape[1]
        names = [name] if width == 1 else [f"{name}_{k + 1}" for k in range(width)]
        columns |= dict(zip(names, rows.T, strict=True))
    return pd.DataFrame(columns, index=pd.RangeIndex(1, samples + 1))
