"""Columns that are one signal twice, and runs that are in other units than the rest."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.recording import Recording, Report

# What differs less from a multiple of another signal has only been rounded.
_SAME = 1 - 1e-9
# All columns of a signal are larger in one run: no motion does that, degrees (57) or mm (1000) do.
_OTHER_UNITS = 40.0
_MOST_ROWS = 50_000


def check_twins(
    recordings: list[Recording], signals: Mapping[str, Columns], report: Report
) -> None:
    """Warns of two columns that are the same signal but for a factor and an offset.

    Args:
        recordings: the runs as they were read.
        signals: the columns of q, u, and v where the log has it.
        report: takes the warnings.
    """
    thin = slice(None, None, max(1, sum(map(len, recordings)) // _MOST_ROWS))
    names, values = [], []
    for signal, columns in signals.items():
        every = np.vstack([getattr(item, signal)[thin] for item in recordings])
        names += [(signal, name) for name in columns.columns]
        values += list(every.T)
    if len(values[0]) < 100:  # too few to tell
        return
    centred = [x - x.mean() for x in values]
    lengths = [float(np.linalg.norm(x)) for x in centred]
    for i, j in itertools.combinations(range(len(names)), 2):
        product = abs(float(centred[i] @ centred[j]))
        if lengths[i] and lengths[j] and product > _SAME * lengths[i] * lengths[j]:
            (one, a), (other, b) = names[i], names[j]
            inputs = one == other == "u"
            report.warn(
                f"columns {a!r} ({one}) and {b!r} ({other}) are the same signal but for a factor: "
                + ("their columns of A cannot be told apart" if inputs else "is one the wrong one?")
            )


def check_units_of_runs(
    recordings: list[Recording], signals: Mapping[str, Columns], report: Report
) -> None:
    """Warns of runs in which all columns of a signal spread far more than in most runs.

    Args:
        recordings: the runs as they were read, of which three or more can tell.
        signals: the columns of q, u, and v where the log has it.
        report: takes the warnings.
    """
    if len(recordings) < 3:
        return
    for signal in signals:
        spreads = np.array([getattr(item, signal).std(axis=0) for item in recordings])
        usual = np.sort(spreads, axis=0)[(len(spreads) - 1) // 2]
        for item, spread in zip(recordings, spreads, strict=True):
            if (usual > 0).all() and (spread > _OTHER_UNITS * usual).all():
                report.warn(
                    f"{item.run}: {signal} spreads {(spread / usual).min():.3g} times as far "
                    "as in most runs: has this run other units?"
                )
