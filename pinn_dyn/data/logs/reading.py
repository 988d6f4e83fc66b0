"""Read files and data frames of a log as recordings in SI units."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from pinn_dyn.data.logs.check.checks import check_clock, check_rows
from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.errors import TRAJECTORY, LogError, listed
from pinn_dyn.data.logs.filling import fill
from pinn_dyn.data.logs.joining import joined, widened
from pinn_dyn.data.logs.readers import find_files, read_tables, run_name
from pinn_dyn.data.logs.recording import Recording, Report
from pinn_dyn.data.logs.registers import rows_before_first_sample
from pinn_dyn.data.logs.stamps import Clock
from pinn_dyn.data.logs.table import Request, Table

Files = str | Sequence[str] | Mapping[str, pd.DataFrame]
_OUT_OF_ORDER = 50  # largest displacement of a row that is out of order; shortest run, in rows


@dataclass(frozen=True)
class Layout:
    """Columns of a log, and the conversion of its tables to recordings.

    Attributes:
        time: clock.
        signals: columns of q, v (if measured) and u.
        trajectory: column that names the run of a row, or None.
        long: column that names the joint of a row, or None.
        max_age, sep: see :class:`~pinn_dyn.data.logs.table.Request`.
        repairs: faults that the cleaning repairs.
    """

    time: Clock
    signals: Mapping[str, Columns]
    trajectory: str | None
    long: str | None
    max_age: float
    sep: str | None
    repairs: Collection[str]

    def read(self, files: Files, root: str, report: Report) -> list[Recording]:
        """Read all runs of a log."""
        recordings: list[Recording] = []
        tables = self._tables(files, root)
        if self.long is not None:
            tables = {
                name: widened(table, self.long, self.time.columns, self.trajectory)
                for name, table in tables.items()
            }
        columns = [name for signal in self.signals.values() for name in signal.columns]
        tables = joined(tables, self.time, columns, self.trajectory)
        notes = pd.Series({x: list(table.notes) for x, table in tables.items()}).explode().dropna()
        for note, stems in notes.groupby(notes, sort=False):
            report.warn("rows", f"{listed(stems.index)}: {note}")
        several = len(tables) > 1
        for stem in list(tables):
            table = tables.pop(stem)  # releases the memory of the table after its conversion
            runs = table.runs(self.trajectory, stem)
            if self.trajectory is not None and several:
                runs = {f"{stem}:{run}": rows for run, rows in runs.items()}
            recordings += [item for _, item in self.recordings(table, runs, report)]
        return recordings

    def _tables(self, files: Files, root: str) -> dict[str, Table]:
        if isinstance(files, Mapping):
            return {name: Table(frame, name) for name, frame in files.items()}
        paths: dict[str, Path] = {}
        for path in find_files(root, files):
            stem = run_name(path, root)
            if stem in paths:
                raise LogError(
                    f"{paths[stem]} and {path} both have the run name {stem!r}: rename a file"
                )
            paths[stem] = path
        several = len(paths) > 1
        columns = [x for part in (self.time, *self.signals.values()) for x in part.columns]
        columns += [] if self.trajectory is None else [self.trajectory]
        request = Request(
            next(iter(self.time.columns), ""), columns, self.max_age, self.sep, several
        )
        tables: dict[str, Table] = {}
        for stem, path in paths.items():
            for run, table in read_tables(path, request).items():
                name = f"{stem}:{run}" if several else run
                tables[name if run else stem] = table
        return tables

    def recordings(
        self, table: Table, runs: Mapping[str, np.ndarray], report: Report
    ) -> list[tuple[np.ndarray, Recording]]:
        """Convert the runs of a table to SI units, and check them.

        Args:
            table: the table.
            runs: mask of the rows of each run.
            report: report that gets notes, warnings and measurements.

        Returns:
            The indices of the rows in the table, and the recording, of each run.
        """
        values = {
            signal: columns.to_si(table.numbers(columns.columns, signal))
            for signal, columns in self.signals.items()
        }
        for signal, columns in {"time": self.time, **self.signals}.items():
            for text in columns.contradictions(signal, table.units):
                report.warn("unit", f"{table.name}: {text}")
        results = []
        for run, mask in runs.items():
            rows = np.flatnonzero(mask)
            t, notes = self.time.seconds(table.select(rows))
            order, starts = _in_order(t)
            if len(starts) or (order[1:] < order[:-1]).any():
                k = int((np.diff(t) < 0).argmax()) + 1
                text = f"{table.place(rows[k], self.time.name)}: the time goes back to {t[k]:.6g} s"
                cure = "rows out of order are sorted"
                if len(starts):
                    cure = (
                        f"a run is assumed to start there ({len(starts)} such rows); name a column "
                        f"of the runs in {TRAJECTORY}"
                    )
                report.warn("clock", f"{text}: {cure}")
            rows, t = rows[order], t[order]
            pieces = np.split(np.arange(len(rows)), starts)
            for k, piece in enumerate(pieces):
                name = f"{run}:{k + 1}" if len(pieces) > 1 else run
                chosen: np.ndarray | slice = rows[piece]
                if len(piece) == len(table) and (np.diff(rows[piece]) == 1).all():
                    chosen = slice(None)  # avoids a copy of the table
                part = {signal: x[chosen] for signal, x in values.items()}
                item = Recording(name, t[piece], part["q"], part.get("v"), part["u"])
                read, item = self._checked(item, table, rows[piece], report)
                text = f"{len(item)} rows, {item.duration:.6g} s, from {Path(table.name).name}"
                report.add("Read", name, "; ".join([text, *notes]))
                results.append((read, item))
        return results

    def _checked(
        self, item: Recording, table: Table, rows: np.ndarray, report: Report
    ) -> tuple[np.ndarray, Recording]:
        """Fill the empty cells of a recording, and check it.

        Return the indices of its rows in the log, and the recording.
        """
        part = table.select(rows)
        # If times decrease, check_clock raises an error below.
        if np.isnan(item.values()).any() and (np.diff(item.t) >= 0).all():
            splits = "gaps" in self.repairs
            stays = fill(item, self.signals, part, self.max_age, report, splits=splits)
            rows, item, part = rows[stays], item.rows(stays), part.select(stays)
        if count := rows_before_first_sample(item.q):
            text = f"q jumps after the first {count} rows, before the first measurement"
            report.warn("rows", f"{part.place(0)}: {text}: left out")
            stays = np.arange(count, len(item))
            rows, item, part = rows[stays], item.rows(stays), part.select(stays)
        report.measurements += check_clock(item.t, part, self.time, self.repairs)
        for signal, columns in self.signals.items():
            x = getattr(item, signal)
            report.measurements += check_rows(part, item.t, signal, columns, x, self.repairs)
        return rows, item


def _in_order(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an order that sorts single late rows, and the rows at which further runs start."""
    order = np.argsort(t, kind="stable")
    spacing = np.diff(t[order])
    far = np.abs(order - np.arange(len(t))) > _OUT_OF_ORDER
    if far.any() or (spacing < 0.5 * np.median(spacing)).any():
        order = np.arange(len(t))
    starts = np.flatnonzero(np.diff(t[order]) < 0) + 1
    return order, starts if len(starts) * _OUT_OF_ORDER < len(t) else starts[:0]
