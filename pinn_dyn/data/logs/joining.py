"""Join signals of a run from several tables, or from the rows of a long table."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.stamps import Clock
from pinn_dyn.data.logs.table import Table

_SAME = 0.05  # largest distance of stamps of the same sample, in usual sample times
_PARTS = (r"[^\W_]+", r"[^\W\d_]+|\d+")  # parts of names: words; or words and numbers


def widened(table: Table, key: str, time: Sequence[str], trajectory: str | None) -> Table:
    """Convert a table with a row per joint and time to a row per time.

    The new columns are ``<name>/<joint>``.

    Args:
        table: table with a row per joint and time.
        key: column that names the joint.
        time: columns of the time. If empty, the rows of each joint are counted.
        trajectory: column of the run, or None.

    Raises:
        LogError: if a joint has two rows at the same time.
    """
    joints = table.column(key, "long")
    index = [*(time or ["row"]), *([trajectory] if trajectory else [])]
    frame = table.frame.assign(row=table.frame.groupby(joints.to_numpy()).cumcount())
    if (repeats := frame.duplicated([*index, key])).any():
        location = table.place(int(repeats.argmax()), key, "long")
        raise LogError(f"{location}: a second row of this joint at the same time: drop the row")
    wide = frame.set_index([*index, key]).unstack(key)
    wide.columns = pd.Index([f"{name}/{joint}" for name, joint in wide.columns])
    rows = frame[index].drop_duplicates()
    return replace(table, frame=rows.merge(wide.reset_index(), on=index), row="row")


def joined(
    tables: Mapping[str, Table], clock: Clock, columns: Sequence[str], trajectory: str | None
) -> dict[str, Table]:
    """Join tables that hold parts of the columns. The first column is the clock of the result.

    Tables with the same columns belong to different runs. Words common to the names of all these
    tables are ignored. Tables are matched by the remaining words: ``run1_pos`` and ``run1_vel``, or
    ``run1/pos`` and ``run1/vel``. A column ``elbow/q`` is the column ``q`` of a table with
    ``elbow`` in its name.

    Raises:
        LogError: if no table has a column, or the tables cannot be matched by their names.
    """
    requested = [*columns, *clock.columns]
    tables = {stem: _prefixed(table, stem, requested) for stem, table in tables.items()}
    parts = {name: tuple(filter(table.__contains__, columns)) for name, table in tables.items()}
    if len(tables) == 1 or any(len(part) == len(columns) for part in parts.values()):
        return dict(tables)
    kinds = sorted(dict.fromkeys(parts.values()), key=lambda part: columns[0] not in part)
    for column in columns:
        if not any(column in part for part in kinds):
            next(iter(tables.values())).column(column, "the log")
    for pattern in _PARTS:
        words_of = {name: re.findall(pattern, name) for name in tables}
        runs: dict[str, list[str]] = {}
        for kind in kinds:
            names = [name for name in tables if parts[name] == kind]
            elsewhere = {word for name in tables.keys() - names for word in words_of[name]}
            usual = set.intersection(*(set(words_of[name]) for name in names)) - elsewhere
            for name in names:
                run = "_".join(word for word in words_of[name] if word not in usual)
                runs.setdefault(run, []).append(name)
        if all([parts[name] for name in names] == kinds for names in runs.values()):
            return {
                run or "+".join(names): _join([tables[x] for x in names], clock, trajectory)
                for run, names in runs.items()
            }
    raise LogError(
        f"the files {listed(tables)} hold parts of the columns, but their names do not tell which "
        "files belong to the same run: name them as run1_q, run1_u, run2_q, run2_u"
    )


def _prefixed(table: Table, stem: str, columns: Sequence[str]) -> Table:
    """Rename a column ``q`` to the requested ``<word>/q``, where the table's name has the word."""
    pairs = {x: x.rpartition("/") for x in columns if x not in table}
    names = {
        x: name
        for x, (word, _, name) in pairs.items()
        if name in table and re.search(rf"(^|[\W_]){re.escape(word)}([\W_]|$)", stem) and word
    }
    frame = table.frame.assign(**{x: table.frame[name] for x, name in names.items()})
    return replace(table, frame=frame) if names else table


def _join(tables: Sequence[Table], clock: Clock, trajectory: str | None) -> Table:
    """Join the rows of tables with the same stamps; otherwise merge all rows, with empty cells."""
    shortest = min(map(len, tables))
    if 0 < max(map(len, tables)) - shortest <= 1 and not all(
        x in table for table in tables for x in clock.columns
    ):
        text = "the last row is left out: some files are a row shorter"
        tables = [replace(x.select(np.arange(shortest)), notes=[*x.notes, text]) for x in tables]
    first, *further = tables
    name = " + ".join([first.name, *(Path(x.name).name for x in further)])
    notes = list(dict.fromkeys(note for table in tables for note in table.notes))
    clocks = [all(x in table for x in clock.columns) for table in tables]
    origin = tables[clocks.index(True)] if any(clocks) else first
    pairs = zip(tables, clocks, strict=True)
    times = [clock.seconds(table, origin)[0] if stamped else None for table, stamped in pairs]
    frames = [table.frame for table in tables]
    stamps = [x for x in times if x is not None]
    if all(len(x) == len(first) for x in tables) and all(_same(stamps[0], x) for x in stamps):
        frame = pd.concat([frame.set_axis(first.frame.index) for frame in frames], axis=1)
        frame = frame.loc[:, ~frame.columns.duplicated()]
        return replace(first, frame=frame, name=name, notes=notes)
    for table, x in zip(tables, times, strict=True):
        if x is None or clock.rate or trajectory:
            raise LogError(
                f"{table.name} has {len(table)} rows and {first.name} has {len(first)}: expected "
                "the same rows, or a clock in both (and a single run)"
            )
        if (back := np.diff(x) < 0).any():
            location = table.place(int(back.argmax()) + 1, clock.name)
            raise LogError(f"{location}: the time goes back, expected a single run in each file")
    frame = pd.concat(map(_with_file, tables))
    order = np.argsort(np.concatenate(stamps), kind="stable")
    return replace(first, frame=frame.iloc[order], name=name, notes=notes)


def _with_file(table: Table) -> pd.DataFrame:
    file = Path(table.name).name
    return table.frame.set_axis([f"{row} of {file}" for row in table.frame.index])


def _same(t: np.ndarray, x: np.ndarray) -> bool:
    return bool(np.abs(t - x).max() <= _SAME * np.median(np.abs(np.diff(t))))
