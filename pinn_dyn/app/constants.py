"""Fitted constants of a run: written by train.py, read by evaluate.py."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path

import pandas as pd

from pinn_dyn.data import DataSource
from pinn_dyn.data.whole import read_regular, write_whole
from pinn_dyn.evaluation.identification import (
    COLUMNS,
    common_factor,
    constants_table,
    contradicted,
    undetermined,
)
from pinn_dyn.evaluation.plots import units
from pinn_dyn.evaluation.rigid_excitation import rigid_excitation
from pinn_dyn.mechanics import Predictor, Trajectory, double_copy
from pinn_dyn.models import KnownMechanics, LearnedConstants
from pinn_dyn.training import Fit

log = logging.getLogger(__name__)

_CONSTANTS = "constants.csv"
_SHOWN = 2  # directions in the log
_MOVE = "Move {} at more frequencies, poses and speeds. excite.py designs such a motion."
_NO_MOTION = (
    "Other constants act on the joints only in sums with further ones, or not at all. No motion "
    "determines them one by one, and no prediction depends on it. Their `known` in constants.csv "
    "is small."
)
_SCALE = (
    "The data determine all constants per drive gain only. Their common factor is held by the "
    "priors, to within a factor of {:.2g} (95 %). If the gains are known, set model.drive_gain and "
    "model.gain_spread=0. If a body is known, set a small prior for it, as "
    "'model.spread={{default: 3, {}: 0.01}}'."
)


def write_constants(
    model: Predictor,
    result: Fit,
    source: DataSource,
    folder: Path,
    runs: Sequence[Trajectory],
    cutoff: float,
) -> None:
    """Write the constants with 95 % intervals, and the ones that the data do not determine.

    The motions ``runs``, filtered at ``cutoff`` Hz, determine the same combinations of the
    constants of rigid bodies as in the check of a log.
    """
    assert isinstance(model, LearnedConstants)
    table = constants_table(model, result, [units([label]) for label in source.input_labels])
    path = folder / _CONSTANTS
    write_whole(path, table.to_csv(index=False, float_format="%.4g"))
    log.info("constants and their intervals are in %s", path)
    remarks = []
    if isinstance(model, KnownMechanics):
        excitation = rigid_excitation(double_copy(model).structure, runs, cutoff=cutoff)
        lines = [x for x in excitation.undetermined.split("; ") if x != "none"]
        head = (
            f"{len(lines)} of {excitation.count} base parameters are not determined by the motions"
        )
        if lines:
            remarks.append(_MOVE.format(", ".join(excitation.open_joints)))
        remarks.append(_NO_MOTION)
        if model.gain is not None:
            body = model.structure.body_names[-1]
            remarks.append(_SCALE.format(common_factor(model, result), body))
    else:
        lines = undetermined(model, result)
        head = f"{len(lines)} of {len(table)} directions of the constants are held by the prior"
    conflicts = contradicted(model, result)
    path = folder / "undetermined.md"
    parts = [f"{head}.", "\n".join(f"- {x}" for x in lines), *conflicts, *remarks]
    write_whole(path, "\n\n".join(filter(None, parts)) + "\n")
    if lines:
        log.warning("%s, see %s: %s ...", head, path, "; ".join(lines[:_SHOWN]))
    for text in conflicts:
        log.warning(text)


def read_constants(folders: Mapping[str, Path]) -> dict[str, pd.DataFrame]:
    """Read the constants of runs by their names; earlier versions wrote fewer columns."""
    return {
        name: pd.read_csv(StringIO(read_regular(path))).reindex(columns=COLUMNS)
        for name, folder in folders.items()
        if (path := folder / _CONSTANTS).is_file()
    }
