"""A table of a log, which names its rows and columns in messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from pinn_dyn.data.logs.errors import LogError, listed, shown
from pinn_dyn.spelling import did_you_mean


@dataclass(frozen=True)
class Table:
    """Columns of a log file or of a data frame.

    Attributes:
        frame: the columns; its index names the rows in messages, such as the line in the file.
        name: file or frame, for messages.
        row: word for a row: ``"line"`` of a text file, ``"row"`` otherwise.
        notes: remarks of the reader, such as dropped rows.
    """

    frame: pd.DataFrame
    name: str
    row: str = "row"
    notes: Sequence[str] = ()

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, rows: np.ndarray) -> Table:
        """Return the rows of a mask or of positions."""
        return replace(self, frame=self.frame.iloc[rows])

    def place(self, row: int, column: str = "", signal: str = "") -> str:
        """Name a cell: file, row, column and the signal that reads it."""
        text = f"{self.name}, {self.row} {self.frame.index[row]}"
        text += f", column {column!r}" if column else ""
        return text + (f" ({signal})" if signal else "")

    def column(self, name: str, signal: str) -> pd.Series:
        """Return one column as it is.

        Raises:
            LogError: if the column is missing or ambiguous; names the closest column.
        """
        count = list(self.frame.columns).count(name)
        if count > 1:
            raise LogError(f"{self.name}: {count} columns have the name {name!r}")
        if not count:
            hint = did_you_mean(name, map(str, self.frame.columns)) or "."
            raise LogError(
                f"{self.name}: no column {name!r}, which {signal} reads{hint} "
                f"The log has {listed(self.frame.columns)}"
            )
        return self.frame[name]

    def numbers(self, columns: Sequence[str], signal: str) -> np.ndarray:
        """Return columns as finite numbers, ``(T, K)``.

        Raises:
            LogError: if a column is missing, or a value is no finite number; names its row.
        """
        return np.column_stack([self._numbers(name, signal) for name in columns])

    def _numbers(self, name: str, signal: str) -> np.ndarray:
        raw = self.column(name, signal)
        values = pd.to_numeric(raw, errors="coerce").to_numpy(dtype=float)
        bad = ~np.isfinite(values)
        if bad.any():
            k = int(bad.argmax())
            text = "empty or NaN" if pd.isna(raw.iloc[k]) else shown(str(raw.iloc[k]))
            raise LogError(
                f"{self.place(k, name, signal)}: the value is {text}, expected a number with a "
                f"decimal point, a time in seconds ({int(bad.sum())} such rows in this column)"
            )
        return values

    def runs(self, column: str) -> dict[str, np.ndarray]:
        """Return the rows of each run, masks ``(T,)``, in order of appearance.

        Raises:
            LogError: if a row has no name of a run in the column.
        """
        names = self.column(column, "trajectory")
        if names.isna().any():
            row = int(names.isna().to_numpy().argmax())
            raise LogError(f"{self.place(row, column, 'trajectory')}: expected the name of a run")
        names = names.astype(str)
        return {run: (names == run).to_numpy() for run in names.unique()}
