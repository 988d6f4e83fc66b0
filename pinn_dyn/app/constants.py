"""Fitted constants of a run: written by train.py, read by evaluate.py."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from pinn_dyn.data import DataSource
from pinn_dyn.data.whole import write_whole
from pinn_dyn.evaluation.identification import (
    COLUMNS,
    constants_table,
    determined_together,
    undetermined,
)
from pinn_dyn.evaluation.plots import units
from pinn_dyn.mechanics import Predictor
from pinn_dyn.models import LearnedConstants
from pinn_dyn.training import Fit

log = logging.getLogger(__name__)

_CONSTANTS = "constants.csv"
_UNFINISHED = "constants_unfinished.csv"
_UNDETERMINED = "undetermined.md"
_SHOWN = 2  # lines of each kind in the log


def write_constants(model: Predictor, result: Fit, source: DataSource, folder: Path) -> None:
    """Write the constants with their 95 % intervals, and the directions that the prior determines.

    A fit that was stopped writes its constants alone, to ``constants_unfinished.csv``.
    """
    assert isinstance(model, LearnedConstants)
    inputs = [units([label]) for label in source.input_labels]
    table = constants_table(model, result, inputs)
    if result.stopped_in is not None:
        write_whole(folder / _UNFINISHED, table.to_csv(index=False))
        log.warning(
            "the fit is not finished: its best constants so far are in %s", folder / _UNFINISHED
        )
        return
    (folder / _UNFINISHED).unlink(missing_ok=True)
    together = determined_together(model, result, inputs)
    table = pd.concat([table, together])
    write_whole(folder / _CONSTANTS, table.to_csv(index=False))
    log.info("constants and their intervals are in %s", folder / _CONSTANTS)
    prior = undetermined(model, result)
    combined = [
        f"{row.name}: only this is determined, {row.value:.4g} ({row.low:.4g} to {row.high:.4g}) "
        f"{row.unit}"
        for row in together.itertuples(index=False)
    ]
    head = (
        f"{len(prior)} of {len(model.parameter_names())} directions of the constants are held by "
    )
    head += "the prior, not by the data"
    path = folder / _UNDETERMINED
    write_whole(path, f"{head}.\n\n" + "".join(f"- {line}\n" for line in [*combined, *prior]))
    if combined or prior:
        shown = [*combined[:_SHOWN], *prior[:_SHOWN]]
        more = len(combined) + len(prior) - len(shown)
        shown += [f"and {more} more lines in {path}" if more else f"see {path}"]
        log.warning("%s: %s", head, "; ".join(shown))


def read_constants(folders: Mapping[str, Path]) -> dict[str, pd.DataFrame]:
    """Read the constants of runs by their names; a damaged file is left out with a warning."""
    tables = {}
    for name, folder in folders.items():
        path = folder / _CONSTANTS
        if not path.is_file():
            continue
        try:
            table = pd.read_csv(path).reindex(columns=COLUMNS)  # earlier versions wrote fewer
        except ValueError as error:
            log.warning("left out: %s cannot be read, it may be cut short: %s", path, error)
            continue
        table["known"] = pd.to_numeric(table["known"], errors="coerce")
        tables[name] = table
    return tables
