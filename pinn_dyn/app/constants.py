"""Fitted constants of a run: written by train.py, read by evaluate.py."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from io import StringIO
from pathlib import Path

import pandas as pd

from pinn_dyn.data import DataSource
from pinn_dyn.data.whole import read_regular, write_whole
from pinn_dyn.evaluation.identification import COLUMNS, constants_table, undetermined
from pinn_dyn.evaluation.plots import units
from pinn_dyn.mechanics import Predictor
from pinn_dyn.models import LearnedConstants
from pinn_dyn.training import Fit

log = logging.getLogger(__name__)

_CONSTANTS = "constants.csv"
_SHOWN = 2  # directions in the log


def write_constants(model: Predictor, result: Fit, source: DataSource, folder: Path) -> None:
    """Write the constants with 95 % intervals, and the directions that the prior determines."""
    assert isinstance(model, LearnedConstants)
    table = constants_table(model, result, [units([label]) for label in source.input_labels])
    path = folder / _CONSTANTS
    write_whole(path, table.to_csv(index=False, float_format="%.4g"))
    log.info("constants and their intervals are in %s", path)
    lines = undetermined(model, result)
    head = f"{len(lines)} of {len(table)} directions of the constants are held by the prior"
    path = folder / "undetermined.md"
    write_whole(path, f"{head}, not by the data.\n\n" + "".join(f"- {x}\n" for x in lines))
    if lines:
        log.warning("%s, not by the data, see %s: %s ...", head, path, "; ".join(lines[:_SHOWN]))


def read_constants(folders: Mapping[str, Path]) -> dict[str, pd.DataFrame]:
    """Read the constants of runs by their names; earlier versions wrote fewer columns."""
    return {
        name: pd.read_csv(StringIO(read_regular(path))).reindex(columns=COLUMNS)
        for name, folder in folders.items()
        if (path := folder / _CONSTANTS).is_file()
    }
