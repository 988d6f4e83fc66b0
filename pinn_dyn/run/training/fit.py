"""Training on a data frame in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from pydantic import PositiveInt

from pinn_dyn.data import LogSource
from pinn_dyn.data.logs.step import Step
from pinn_dyn.mechanics import Predictor
from pinn_dyn.run.configuration.build import ModelBuilder
from pinn_dyn.run.run import Run
from pinn_dyn.run.training.train import train

Signals = str | Sequence[str] | Mapping[str, Any]

_SI = {"time": "s", "v": "1/s", "q": "1", "u": "1"}


def fit(
    frame: pd.DataFrame | str | Path | Sequence[Any] | Mapping[str, Any],
    *,
    q: Signals,
    u: Signals | None,
    v: Signals | None = None,
    time: Signals = "t",
    run: str | None = None,
    model: str | ModelBuilder | Predictor = "lnn",
    cleaning: Mapping[str, Step] | None = None,
    delay: float | Sequence[float] = 0.0,
    steps: PositiveInt | None = None,
    seed: int = 0,
    **options: Any,
) -> Run:
    """Train a model on a log with one row per sample, and return the run.

    The log is read, checked, split and cleaned, see
    :class:`~pinn_dyn.data.logs.LogSource`; 15 % are for validation and 15 % for the test. For
    other splits, call :func:`~pinn_dyn.train` on a ``LogSource``.

    Args:
        frame: the log as a data frame; as data frames of its runs, in a list or by name; as a
            mapping from the names of columns to values; or as paths of files.
        q, u, v: columns of the configuration, the input and, if measured, the velocity: names in
            SI units, or ``{"columns": [...], "unit": "deg"}`` and other arguments of
            :class:`~pinn_dyn.data.logs.Columns`.
        time: column of the time, described like q; ``"index"``, or ``{"rate": 100}`` in Hz
            without a time.
        run: column that tells runs apart; None if all rows are one run.
        model: as in :func:`~pinn_dyn.train`.
        cleaning: names and steps of the cleaning, in order.
        delay: time between an input and its action, one number or M, s.
        steps: steps of the optimizer; None for the default, see :func:`~pinn_dyn.train`.
        seed: seed of the weights, the batches and the choice of runs.
        options: other arguments of :func:`~pinn_dyn.train`, such as ``folder="runs/arm"``.

    Raises:
        TypeError: if the log is an array, whose columns have no names.
        ValueError: if columns, units, clocks or settings cannot be used; names them.
        NonFiniteLossError: if the loss becomes NaN or infinite.
    """
    if isinstance(steps, Mapping):
        raise TypeError("steps are those of the optimizer: cleaning={...} has the steps of the log")
    signals = {"time": time, "q": q, "u": u, "v": v}
    columns: dict[str, Any] = {
        name: {"columns": value, "unit": _SI[name]} if isinstance(value, (str, Sequence)) else value
        for name, value in signals.items()
    }
    files = _files(frame)
    settings: dict[str, Any] = {"trajectory": run, "steps": cleaning, "delay": delay}
    source = LogSource(files=files, seed=seed, **settings, **columns)
    return train(source, model, steps=steps, seed=seed, **options)


def _files(log: Any) -> Any:
    """Return a data frame, data frames by the names of their runs, or paths of files."""
    items = list(log.values()) if isinstance(log, Mapping) else log
    items = [items] if isinstance(items, str | Path | pd.DataFrame) else items
    are_frames = isinstance(items, Sequence) and all(isinstance(x, pd.DataFrame) for x in items)
    if isinstance(log, Mapping) and not are_frames:
        return pd.DataFrame(log)
    if are_frames:
        return log if not isinstance(log, Sequence) else {f"run_{k}": x for k, x in enumerate(log)}
    if isinstance(items, Sequence) and all(isinstance(x, str | Path) for x in items):
        return [str(path) for path in items]
    raise TypeError(
        f"the log is a {type(log).__name__}, expected a data frame, data frames in a list or dict, "
        "a dict of columns, or paths of files: name the columns of an array, as in "
        "pandas.DataFrame(array, columns=['t', 'q1', 'u1'])"
    )
