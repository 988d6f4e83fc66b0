"""A table of a log, and a request for its columns."""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.wording import did_you_mean


@dataclass(frozen=True)
class Request:
    """Request for the columns of a file.

    Attributes:
        time: first column of the time; empty if the log has a rate instead.
        columns: all columns, including those of the time. A reader may return more columns.
        max_age: largest age of a message of another topic in a row of a bag, s.
        sep: separator of the cells of a text file; None detects the separator.
        partial: true if the time may be in another file.
    """

    time: str
    columns: Sequence[str]
    max_age: float = 0.1
    sep: str | None = None
    partial: bool = False


def vector_columns(name: str, cells: pd.Series) -> dict[str, pd.Series]:
    """Return the entries of vectors as columns ``name_1``, ``name_2`` and so on."""
    vectors = cells.dropna()
    entries = itertools.zip_longest(*vectors, fillvalue=np.nan)
    columns = [pd.Series(x, vectors.index, float).reindex(cells.index) for x in entries]
    return {f"{name}_{k}": column for k, column in enumerate(columns, start=1)}


def optional(name: str, path: Path) -> Any:
    """Import a module of the extra ``logs``."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        package = name.split(".")[0]
        raise LogError(f"{path} needs {package}: pip install 'pinn_dyn[logs]'") from error


@dataclass(frozen=True)
class Table:
    """Columns of a log file or of a data frame.

    Attributes:
        frame: the columns. The index names rows in messages, such as the line in the file.
        name: file or frame, for messages.
        row: word for a row in messages: ``"line"`` for text files, otherwise ``"row"``.
        notes: notes of the reader, such as on dropped rows.
        units: texts in the file that may be units of columns.
        hint: end of the message about a missing column.
    """

    frame: pd.DataFrame
    name: str
    row: str = "row"
    notes: Sequence[str] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    hint: str = ""

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, rows: np.ndarray) -> Table:
        """Return the rows of a mask or of indices."""
        return replace(self, frame=self.frame.iloc[rows])

    def place(self, row: int, column: str = "", signal: str = "") -> str:
        """Return a description of a cell: file, row, column and signal."""
        text = f"{self.name}, {self.row} {self.frame.index[row]}"
        text += f", column {column!r}" if column else ""
        return text + (f" ({signal})" if signal else "")

    def __contains__(self, name: str) -> bool:
        index = () if self.row == "line" else ("index", *self.frame.index.names)
        return name in self.frame.columns or name in index

    def column(self, name: str, signal: str) -> pd.Series:
        """Return a column, or a level of the index, without conversion."""
        count = list(self.frame.columns).count(name)
        matches = self.frame.loc[:, self.frame.columns == name]
        if any(not matches.iloc[:, 0].equals(match) for _, match in matches.items()):
            raise LogError(f"{self.name}: {count} columns have the name {name!r}")
        if not count and name in self:
            index = self.frame.index
            return (index if name == "index" else index.get_level_values(name)).to_series()
        if not count:
            hint = did_you_mean(name, map(str, self.frame.columns)) or "."
            names = f"{self.hint or hint} The log has {listed(self.frame.columns)}"
            raise LogError(f"{self.name}: no column {name!r}, which {signal} reads{names}")
        return matches.iloc[:, 0]

    def numbers(self, columns: Sequence[str], signal: str) -> np.ndarray:
        """Return columns as finite numbers, ``(T, K)``, with NaN for empty cells."""
        values = np.empty((len(self), len(columns)))
        for k, name in enumerate(columns):
            values[:, k] = self._numbers(name, signal)
        return values

    def _numbers(self, name: str, signal: str) -> np.ndarray:
        raw = self.column(name, signal)
        values = pd.to_numeric(raw, errors="coerce").to_numpy(dtype=float)
        bad = ~np.isfinite(values) & ~(np.isnan(values) & raw.isna().to_numpy())
        if bad.any():
            k = int(bad.argmax())
            text = f"{str(raw.iloc[k])!r}"[:80]
            text += f", expected a number such as 1234.5 ({int(bad.sum())} such rows)"
            raise LogError(f"{self.place(k, name, signal)}: the value is {text}")
        return values

    def runs(self, column: str | None, name: str) -> dict[str, np.ndarray]:
        """Return a mask ``(T,)`` of rows for each run; without a column, a single run ``name``."""
        if column is None:
            return {name: np.ones(len(self), dtype=bool)}
        names = self.column(column, "trajectory")
        if names.isna().any():
            location = self.place(int(names.isna().to_numpy().argmax()), column, "trajectory")
            raise LogError(f"{location}: expected the name of a run")
        names = names.astype(str)
        return {run: (names == run).to_numpy() for run in names.unique()}


def alternates(x: np.ndarray) -> bool:
    """Return true for numbers ``(T,)`` that alternate between two sources."""
    one_row, two_rows = (float(np.median(np.abs(x[n:] - x[:-n]))) for n in (1, 2))
    return one_row > 0.02 * np.ptp(x) and two_rows < 0.2 * one_row
