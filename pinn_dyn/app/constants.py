"""The fitted constants of a run: written by train.py, read by evaluate.py."""

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
    """Write the constants with their 95 % intervals, and what the data leave to the prior.

    Those of a fit that was stopped are in a file of another name, alone.
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
    left = undetermined(model, result)
    known = [
        f"{row.name}: only this is determined, {row.value:.4g} ({row.low:.4g} to {row.high:.4g}) "
        f"{row.unit}"
        for row in together.itertuples(index=False)
    ]
    head = f"{len(left)} of {len(model.parameter_names())} directions of the constants are held by "
    head += "the prior, not by the data"
    path = folder / _UNDETERMINED
    write_whole(path, f"{head}.\n\n" + "".join(f"- {line}\n" for line in [*known, *left]))
    if known or left:
        shown = [*known[:_SHOWN], *left[:_SHOWN]]
        more = len(known) + len(left) - len(shown)
        shown += [f"and {more} more lines in {path}" if more else f"see {path}"]
        log.warning("%s: %s", head, "; ".join(shown))


def read_constants(folders: Mapping[str, Path]) -> dict[str, pd.DataFrame]:
    """The constants of those runs that have some, by their names; a damaged file is passed over."""
    found = {}
    for name, folder in folders.items():
        path = folder / _CONSTANTS
        if not path.is_file():
            continue
        try:
            table = pd.read_csv(path).reindex(columns=COLUMNS)  # of older runs it has fewer
        except ValueError as error:
            log.warning("passed over: %s cannot be read, it may be cut short: %s", path, error)
            continue
        table["known"] = pd.to_numeric(table["known"], errors="coerce")
        found[name] = table
    return found
