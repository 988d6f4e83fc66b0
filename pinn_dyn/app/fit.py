"""Training on a data frame in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import pandas as pd
from pydantic import PositiveInt

from pinn_dyn.app.run import ModelBuilder, Run
from pinn_dyn.app.trainer import even_validations
from pinn_dyn.app.training import MODELS, train
from pinn_dyn.data import DynamicsData, LogSource
from pinn_dyn.data.logs.step import Step
from pinn_dyn.evaluation import RolloutValidator
from pinn_dyn.mechanics import Predictor
from pinn_dyn.training import LeastSquares

Signals = str | Sequence[str] | Mapping[str, Any]

STEPS = 1000
"""Default steps of the optimizer."""
_PAIRS, _BATCH = 10_000, 128  # at most
_WINDOW, _STEP = 2, 0.02  # steps of a training window, and their length in s
_FEW_PAIRS, _LONG_WINDOW = 150, 10  # pairs for least squares, and steps for it and subnet
_HISTORY = 0.5  # s of the past, for subnet
_HORIZON = 2.0  # s, at most, of the rollouts that choose the best checkpoint
_SI = {"time": "s", "v": "1/s", "q": "1", "u": "1"}


def fit(
    frame: pd.DataFrame,
    *,
    q: Signals,
    u: Signals | None,
    v: Signals | None = None,
    time: Signals = "t",
    run: str | None = None,
    model: str | ModelBuilder | Predictor = "lnn",
    cleaning: Mapping[str, Step] | None = None,
    steps: PositiveInt = STEPS,
    seed: int = 0,
    **options: Any,
) -> Run:
    """Train a model on a data frame with one row per sample, and return the run.

    The frame is read, checked, split and cleaned like a log file, see
    :class:`~pinn_dyn.data.logs.LogSource`; 15 % are for validation and 15 % for the test. For
    other splits, call :func:`~pinn_dyn.train` on a ``LogSource``.

    Args:
        frame: the log.
        q, u, v: columns of the configuration, the input and, if measured, the velocity: names in
            SI units, or ``{"columns": [...], "unit": "deg"}`` and other arguments of
            :class:`~pinn_dyn.data.logs.Columns`.
        time: column of the time, described like q; ``"index"``, or ``{"rate": 100}`` in Hz
            without a time.
        run: column that tells runs apart; None if all rows are one run.
        model: as in :func:`~pinn_dyn.train`.
        cleaning: names and steps of the cleaning, in order.
        steps: steps of the optimizer.
        seed: seed of the weights, the batches and the choice of runs.
        options: other arguments of :func:`~pinn_dyn.train`, such as ``folder="runs/arm"``.

    Raises:
        ValueError: if columns, units, clocks or settings cannot be used; names them.
        NonFiniteLossError: if the loss becomes NaN or infinite.
    """
    signals = {"time": time, "q": q, "u": u, "v": v}
    columns: dict[str, Any] = {
        name: {"columns": value, "unit": _SI[name]} if isinstance(value, (str, Sequence)) else value
        for name, value in signals.items()
    }
    source = LogSource(
        name="frame", files=frame, trajectory=run, steps=cleaning, seed=seed, **columns
    )
    splits = source.load()
    t = splits.train[0].t
    stride = max(round(_STEP / float(t[1] - t[0])), 1)
    constants = isinstance(options.get("optimizer"), LeastSquares)
    pairs, window = (_FEW_PAIRS, _LONG_WINDOW) if constants else (_PAIRS, _WINDOW)
    windows = partial(
        DynamicsData, pairs=pairs, steps=window, stride=stride, batch_size=min(_BATCH, pairs)
    )
    horizon = min(_HORIZON, *(item.duration for item in splits.validation))
    if model == "subnet":
        windows = partial(windows, history=_HISTORY, steps=_LONG_WINDOW)
    if model == "hnn":  # a log has no momenta
        options = {"model_name": "hnn", **options}
        model = partial(MODELS["hnn"], state="qv")
    return train(
        source,
        model,
        steps=steps,
        seed=seed,
        **{
            "data": windows,
            "validator": partial(RolloutValidator, horizon=horizon),
            "validations": even_validations(steps, 10),
            **options,
        },
    )
