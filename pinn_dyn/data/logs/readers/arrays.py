"""Read files of arrays as tables: MATLAB, HDF5, NumPy and PyTorch.

An array with as many rows as the time is a column; a matrix gives the columns ``name_1``,
``name_2`` and so on. Names of fields are joined: ``log.q`` in MATLAB, ``log/q`` in HDF5. If groups
are runs, the columns are ``data/*/q``.
"""

from __future__ import annotations

import json
import pickle
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from pinn_dyn import wording
from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.readers.matlab import elements, matlab_variables
from pinn_dyn.data.logs.table import Request, optional, vector_columns
from pinn_dyn.wording import did_you_mean

_KINDS = "fiubmMUTO"  # kinds of arrays that may be columns
_RATE = re.compile(r"(^|[._@/])(fs|fps|hz|(sampl\w*?)?_?(rate|freq\w*)(_hz)?)$", re.IGNORECASE)


def read_mat(path: Path, request: Request) -> dict[str, pd.DataFrame]:
    """Read a MATLAB file. The fields of a struct are ``name.field``."""
    h5py = optional("h5py", path)
    if h5py.is_hdf5(path):  # version 7.3
        with h5py.File(path, "r") as file:
            _data_sets(path, h5py, file, [x.replace(".", "/") for x in request.columns])
            if not any("MATLAB_class" in item.attrs for item in file.values()):
                return read_hdf5(path, request)
    runs = elements(matlab_variables(path), request.columns)
    if len(runs) == 1:
        return _tables(path, request, runs.popitem()[1])
    return {run: table_of_arrays(path, request, variables) for run, variables in runs.items()}


def read_hdf5(path: Path, request: Request) -> dict[str, pd.DataFrame]:
    """Read an HDF5 file. Data sets in other files are not opened.

    The attribute ``fps`` of ``obs`` is the scalar ``obs@fps``.
    """
    h5py = optional("h5py", path)
    with h5py.File(path, "r") as file:
        variables = _data_sets(path, h5py, file, request.columns)
        groups = {name.rpartition("/")[0] for name in variables}
        for name in sorted({"/", *groups, *variables}):
            values = file[name or "/"].attrs.items()
            variables |= {f"{name.strip('/')}@{key}": np.asarray(x) for key, x in values}
        return _tables(path, request, variables)


def _data_sets(path: Path, h5py: Any, file: Any, columns: Collection[str]) -> dict[str, Any]:
    """Return the plain data sets. Raise an error if values of a column lie in other files."""
    plain: dict[str, Any] = {}
    outside: list[str] = []

    def visit(name: str, link: Any) -> None:
        item: Any = file[name] if isinstance(link, h5py.HardLink) else link
        is_set = isinstance(item, h5py.Dataset)
        if isinstance(item, h5py.ExternalLink) or (is_set and (item.external or item.is_virtual)):
            outside.append(name)
        elif is_set:
            plain[name] = item

    file.visititems_links(visit)
    if refused := [x for x in outside if any(y.startswith(x) for y in columns)]:
        raise LogError(
            f"{path}: {listed(refused)}: values of other files or virtual data sets are not read, "
            "expected plain data sets: copy the values into the file"
        )
    return plain


def read_npz(path: Path, request: Request) -> dict[str, pd.DataFrame]:
    """Read an NPZ file. Files with Python objects are rejected, never unpickled."""
    with np.load(path, allow_pickle=False) as file:
        return _tables(path, request, dict(file))


def read_npy(path: Path, request: Request) -> dict[str, pd.DataFrame]:
    """Read a matrix with the columns ``0``, ``1`` and so on, or a structured array with names."""
    return _of_python(path, request, np.load(path, allow_pickle=False))


def read_torch(path: Path, request: Request) -> dict[str, pd.DataFrame]:
    """Read a file of ``torch.save``: a matrix, a dictionary of tensors, or a list of such runs.

    Files with other objects are rejected, never unpickled.
    """
    try:
        content = torch.load(path, weights_only=True, map_location="cpu")
    except pickle.UnpicklingError as error:
        raise LogError(
            f"{path} contains Python objects, which are not loaded: save plain tensors, as in "
            "torch.save({'t': t, 'q': q, 'u': u}, path)"
        ) from error
    return _of_python(path, request, content)


def read_json(path: Path, request: Request) -> dict[str, pd.DataFrame]:
    """Read JSON: a mapping of arrays, a list of such runs, or a list of records.

    A record is a mapping with the numbers of a row. A file ``.jsonl`` has a record per line. Keys
    of nested mappings are joined: ``state.q``. Vectors give the columns ``q_1``, ``q_2``.
    """
    text = path.read_text(encoding="utf-8-sig")
    lines = text.splitlines() if path.suffix.lower() == ".jsonl" else []
    content = [json.loads(line) for line in lines if line.strip()] or json.loads(text)
    prefix, records = _records(content, request.columns)
    frame = pd.json_normalize(records)
    if not isinstance(records, list) or isinstance(frame.get(request.time, [None])[0], list):
        return _of_python(path, request, content)
    columns: dict[str, pd.Series] = {}
    for name, cells in frame.items():
        key = f"{prefix}{name}"
        is_vector = any(isinstance(x, list) for x in cells)
        columns |= vector_columns(key, cells) if is_vector else {key: cells}
    return {"": pd.DataFrame(columns).set_axis(frame.index + 1)}


def _records(content: Any, columns: Collection[str], prefix: str = "") -> tuple[str, Any]:
    """Return the list of records with the columns, and the prefix of its nested keys."""
    if not isinstance(content, Mapping):
        return prefix, content
    for key, value in content.items():
        path = f"{prefix}{key}."
        if any(x.startswith(path) for x in columns):
            if isinstance(value, list) and value and isinstance(value[0], Mapping):
                return path, value
            if isinstance(value, Mapping):
                return _records(value, columns, path)
    return prefix, content


def _of_python(path: Path, request: Request, content: Any) -> dict[str, pd.DataFrame]:
    """Return the tables of an array, of a mapping of arrays, or of a list of such runs."""
    if isinstance(content, list):
        tables = [_of_python(path, request, values) for values in content]
        return {f"{k}{run}": x for k, runs in enumerate(tables) for run, x in runs.items()}
    variables = dict(_nested("", content))
    if "" in variables and not variables[""].dtype.names:
        columns = np.atleast_2d(variables[""]).T
        variables = {str(k): column for k, column in enumerate(columns)}
    return _tables(path, request, variables)


def _nested(name: str, content: Any) -> Iterator[tuple[str, Any]]:
    """Yield the arrays of nested mappings with joined names, such as ``log.q``."""
    if isinstance(content, Mapping):
        for key, value in content.items():
            yield from _nested(f"{name}.{key}".strip("."), value)
    else:
        is_tensor = isinstance(content, torch.Tensor)
        yield name, content.numpy(force=True) if is_tensor else np.asarray(content)


def _tables(path: Path, request: Request, variables: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    runs = _runs(variables, request)
    return {run: table_of_arrays(path, request, values) for run, values in runs.items()}


def _runs(variables: Mapping[str, Any], request: Request) -> dict[str, dict[str, Any]]:
    """Return the variables of each run.

    A run is a text in place of the ``*`` of the columns, a number k of arrays ``t_k``, ``q_k``, or
    an entry of arrays ``(runs, T, N)``, or ``(T, runs, N)`` if they are smooth along T.
    """
    runs: dict[str, dict[str, Any]] = {}
    if stars := [x.split("*") for x in request.columns if "*" in x]:
        before, after = stars[0]
        for name, value in variables.items():
            run, separator, field = name.removeprefix(before).partition(after[:1] or "/")
            if name.startswith(before) and field:
                runs.setdefault(run, {})[f"{before}*{separator}{field}"] = value
        return dict(sorted(runs.items(), key=lambda x: [len(x[0]), x[0]]))
    first = re.compile(rf"{re.escape(request.time)}_(\d+)")
    numbers = [match[1] for match in map(first.fullmatch, variables) if match]
    if request.time not in variables and numbers:
        for run in numbers:
            end = f"_{run}"
            runs[run] = {x.removesuffix(end): y for x, y in variables.items() if x.endswith(end)}
        return runs
    bases = [_base(column, variables) for column in request.columns]
    shapes = {base: variables[base].shape for base in bases if base}
    stacked = [base for base, shape in shapes.items() if len(shape) == 3 and min(shape) > 1]
    if not stacked:
        return {"": dict(variables)}
    rough = [_roughness(variables[stacked[0]], axis) for axis in (0, 1)]
    before_run = (slice(None),) * (rough[0] < 0.5 and rough[1] > 1)
    stacks = {shapes[base][:2] for base in stacked}
    constant = {name: value for name, value in variables.items() if value.shape[:2] not in stacks}
    varying = {name: value for name, value in variables.items() if name not in constant}
    for k in range(next(iter(stacks))[len(before_run)]):
        runs[str(k)] = constant | {x: y[(*before_run, k)] for x, y in varying.items()}
    return runs


def _base(column: str, variables: Mapping[str, Any]) -> str:
    """Return the variable of a column: ``q``, or ``q`` for ``q_1``; "" without a variable."""
    names = (column, column.rpartition("_")[0])
    return next((name for name in names if name in variables), "")


def _roughness(x: Any, axis: int) -> float:
    """Return the ratio of second to first differences of an array, which is small along time."""
    steps = np.diff(x, axis=axis)
    total = np.abs(steps).sum() if x.shape[axis] > 9 else 0.0
    return float(np.abs(np.diff(steps, axis=axis)).sum() / total) if total else np.inf


def table_of_arrays(path: Path, request: Request, variables: Mapping[str, Any]) -> pd.DataFrame:
    """Return a table of the vectors and matrices that have as many rows or columns as the time.

    The time is a vector, a column of a matrix, or a scalar, the sample time.

    Raises:
        LogError: if the time is missing, or a requested column is complex or has another length.
    """
    arrays = {name: _matrix(value) for name, value in _fields(variables) if value.size}
    names = dict.fromkeys(filter(None, [request.time, *request.columns]))
    bases = {name: _base(name, arrays) for name in names}
    lengths = [max(arrays[base].shape) for base in bases.values() if base]
    longest = next((length for length in lengths if length > 1), 0)
    samples = longest - 1 if 1 < longest - 1 in lengths else longest  # N steps have N + 1 states
    columns: dict[str, Any] = {}
    for name, value in arrays.items():
        if value.ndim == 2 and {samples, longest} & {*value.shape} and value.dtype.kind in _KINDS:
            rows = (value.T if len(value) in (samples, longest) else value)[:, :samples]
            numbered = len(rows) > 1
            columns |= {f"{name}_{k}" if numbered else name: x for k, x in enumerate(rows, start=1)}
    scalars = {name: value.item() for name, value in arrays.items() if value.size == 1}
    largest = sorted(arrays.items(), key=lambda item: (-item[1].size, item[0]))
    sizes = [f"{x} {y.shape}" for x, y in largest if x not in scalars]
    sizes += [f"{x} = {y}" for x, y in scalars.items()]
    for name, base in bases.items():
        problem = ""
        if name in scalars and name == request.time:
            columns[name] = scalars[name] * np.arange(samples)
            if _RATE.search(name):
                setting = wording.entry("time", {"rate": scalars[name]})
                problem = f"{name} is a rate: write {setting}."
        elif name not in columns and base:
            problem = f"{name!r} has type {arrays[base].dtype} and shape {arrays[base].shape}, "
            problem += f"expected real numbers in {samples} rows."
        elif name not in columns and name == request.time and not request.partial:
            runs = (re.sub(rf"\d+([_./]{re.escape(name)})$", r"*\1", x) for x in arrays)
            run = next((f", write {x!r}, and so on." for x in runs if "*" in x), ".")
            problem = f"no variable {name!r} for the time{did_you_mean(name, columns) or run} "
            rate = next((y for x, y in scalars.items() if _RATE.search(x)), 100)
            problem += f"Without a clock write {wording.entry('time', {'rate': rate})}, in Hz."
        if problem:
            raise LogError(f"{path}: {problem} The file has {listed(sizes)}")
    table = pd.DataFrame(columns, index=pd.RangeIndex(1, samples + 1))
    if samples < longest:
        table.attrs["notes"] = ["the last row is left out: some variables are a row shorter"]
    return table


def _fields(variables: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the variables by name; for a compound data set its fields, such as ``log/q``."""
    for name, value in variables.items():
        if value.dtype.names:
            yield from ((f"{name}/{field}".strip("/"), value[field]) for field in value.dtype.names)
        else:
            yield name, value


def _matrix(value: Any) -> Any:
    """Return an array as a matrix, with vectors as columns; arrays of more axes unchanged."""
    if value.size > max(value.shape, default=1) and len([n for n in value.shape if n > 1]) > 2:
        return value  # not a column, for example images
    array = np.asarray(value[()])
    array = array.squeeze() if array.ndim > 2 else array
    if array.dtype.kind in "SO":
        texts = [x.decode() if isinstance(x, bytes) else x for x in array.flat]
        array = np.reshape(texts, array.shape)
    if np.iscomplexobj(array) and not array.imag.any():
        array = array.real
    return array.reshape(-1, 1) if array.ndim < 2 else array
