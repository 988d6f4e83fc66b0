"""A table of a log, which names its rows and columns in messages."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

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
        unusable: reason why a column of the file cannot be read, by its name.
        notes: remarks of the reader, such as dropped rows.
    """

    frame: pd.DataFrame
    name: str
    row: str = "row"
    unusable: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, rows: np.ndarray) -> Table:
        """Return the rows of a mask or of positions."""
        return Table(self.frame.iloc[rows], self.name, self.row, self.unusable)

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
        positions = [k + 1 for k, label in enumerate(self.frame.columns) if label == name]
        if len(positions) == 1:
            return self.frame[name]
        if positions:
            raise LogError(f"{self.name}: {len(positions)} columns have the name {name!r}")
        for variable in (name, re.sub(r"_\d+$", "", name)):  # q_1 is the first column of q
            if variable in self.unusable:
                reason = self.unusable[variable]
                raise LogError(f"{self.name}, variable {variable!r} ({signal}): {reason}")
        hint = did_you_mean(name, map(str, self.frame.columns)) or "."
        raise LogError(
            f"{self.name}: no column {name!r}, which {signal} reads{hint} "
            f"The log has {listed(self.frame.columns)}"
        )

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
        if not bad.any():
            return values
        k = int(bad.argmax())
        text = str(raw.iloc[k])
        what = "is empty or NaN" if pd.isna(raw.iloc[k]) else f"is {shown(text)}"
        raise LogError(
            f"{self.place(k, name, signal)}: the value {what}, expected a number with a decimal "
            f"point, a time in seconds ({int(bad.sum())} such rows in this column)"
        )

    def runs(self, column: str) -> dict[str, np.ndarray]:
        """Return the rows of each run, masks ``(T,)``, in order of appearance.

        Args:
            column: column that names the run of a row.

        Raises:
            LogError: if a row has no name.
        """
        names = self.column(column, "trajectory")
        if names.isna().any():
            row = int(names.isna().to_numpy().argmax())
            raise LogError(f"{self.place(row, column, 'trajectory')}: expected the name of a run")
        names = names.astype(str)
        return {run: (names == run).to_numpy() for run in names.unique()}
