"""Read the variables of a MATLAB file, by their names in MATLAB.

A field of a struct is ``log.q``, an element of a struct array ``trial(2).q``, and a cell
``train{2}.q``. A table has its columns; a timetable also has ``TT.Time``. A ``timeseries`` has
``Time`` and ``Data``. A signal of a Simulink data set has the name of its element,
``logsout.q.Data``.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pinn_dyn.data.logs.table import optional

_INDEX = re.compile(r"[({](\d+)[)}]")
# Properties of Simulink objects that only wrap the next object.
_WRAPPERS = ("any", "Storage", "Elements", "Values")


def matlab_variables(path: Path) -> dict[str, Any]:
    """Read the arrays of a MATLAB file, of any version, by their full names."""
    matio = optional("matio", path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings about objects without numbers
        content = matio.load_from_mat(str(path))
    return {name: x for key, value in content.items() for name, x in _leaves(key, value)}


def elements(variables: Mapping[str, Any], columns: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return the variables of each element of the struct or cell arrays with the columns.

    An element is a run. The names of its variables have no index, such as ``trial.q``.
    """
    runs: dict[str, dict[str, Any]] = {}
    for name, value in variables.items():
        run = ",".join(_INDEX.findall(name))
        runs.setdefault(run, {})[_INDEX.sub("", name)] = value
    common = runs.pop("", {})
    names = {*columns, *(column.rpartition("_")[0] for column in columns)}
    runs = {
        run: values
        for run, values in runs.items()
        if any(np.size(values[name]) for name in names & values.keys())
    }
    if not runs or all({x, x.rpartition("_")[0]} & variables.keys() for x in columns):
        return {"": dict(variables)}
    return {run: {**common, **values} for run, values in runs.items()}


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the arrays of a variable with their full names."""
    if isinstance(value, pd.DataFrame):
        if isinstance(value.index, pd.DatetimeIndex | pd.TimedeltaIndex):
            yield f"{name}.{value.index.name}", value.index.to_numpy()
        value = {column: value[column].to_numpy() for column in value}
    if hasattr(value, "properties"):
        value = _properties(value)
    if isinstance(value, Mapping):
        if {"time", "signals"} <= value.keys() and np.size(value["signals"]) > 1:
            yield f"{name}.signals.values", _axes(value["signals"], np.size(value["time"]))
        for key, item in value.items():
            yield from _leaves(name if key in _WRAPPERS else f"{name}.{key}", item)
    elif not isinstance(value, np.ndarray):
        yield name, np.asarray(value)
    elif not value.dtype.hasobject or all(isinstance(x, str) for x in value.flat):
        yield name, value
    else:
        brackets = "{}" if value.dtype == object else "()"
        for k, item in enumerate(value.ravel(order="F"), start=1):
            fields = (
                item if value.dtype == object else dict(zip(value.dtype.names, item, strict=True))
            )
            index = f"{brackets[0]}{k}{brackets[1]}" if value.size > 1 else ""
            yield from _leaves(_element(name, item) or f"{name}{index}", fields)


def _axes(signals: np.ndarray, samples: int) -> np.ndarray:
    """Return the signals of all axes of a Scope in a matrix, ``(T, K)``."""
    values = [np.squeeze(x) for x in signals["values"].flat]
    rows = [x if len(x) == samples else x.T for x in values]
    return np.column_stack(rows)


def _element(name: str, item: Any) -> str:
    """Return the name of an element of a data set, or "" for any other element."""
    properties = getattr(item, "properties", None) or {}
    label = np.ravel(properties.get("Name", "")).tolist() if "Values" in properties else []
    return f"{name}.{label[0]}" if any(label) else ""


def _properties(value: Any) -> Mapping[str, Any]:
    """Return the properties of an object; for a time series, its times and data."""
    properties: Mapping[str, Any] = value.properties or {}
    if value.classname != "timeseries":
        return properties
    data, info = properties["Data_"], properties["TimeInfo"].properties
    times = next((x for x in (properties["Time_"], info["Time_"]) if np.size(x)), None)
    if times is None:  # a uniform clock
        start, step, count = (np.ravel(info[x])[0] for x in ("Start_", "Increment_", "Length"))
        times = start + step * np.arange(int(count))
    return {"Time": times, "Data": data}
