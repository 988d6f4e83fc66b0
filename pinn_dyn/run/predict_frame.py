"""Prediction along a data frame, in the columns, units and rows of a log."""

from __future__ import annotations

import numpy as np
import pandas as pd
import torch

from pinn_dyn.data import LogSource
from pinn_dyn.data.logs import Recording
from pinn_dyn.mechanics import Predictor, Signal


def predict_frame(model: Predictor, source: LogSource, frame: pd.DataFrame) -> pd.DataFrame:
    """Predict q and v along each run of a frame, from its first row and under its inputs.

    Raises:
        LogError: if the frame lacks columns of the log or fails its checks.
        ValueError: if a model that predicts in fixed steps does not fit the sample time.
    """
    rates = [f"d{name}/dt" for name in source.q.columns] if source.v is None else []
    names = source.q.columns + (rates if source.v is None else source.v.columns)
    values = np.full((len(frame), len(names)), np.nan)
    alike: dict[tuple[int, float], list[tuple[np.ndarray, Recording, Recording]]] = {}
    for item in source.recordings(frame):
        step = round(item[2].sample_time("predict"), 9)
        alike.setdefault((len(item[2]), step), []).append(item)
    for (_, step), items in alike.items():  # runs of one length side by side
        clock, times, states = _along(model, source, [clean for _, _, clean in items], step)
        for (rows, raw, clean), x in zip(items, states, strict=True):
            # The uniform clock of the data, at the log's own times.
            now = np.interp(raw.t, clean.t, clock, left=np.nan, right=np.nan)
            columns = [np.interp(now, times, column, right=np.nan) for column in x.T]
            q, v = np.split(np.column_stack(columns), 2, axis=1)
            v = v / source.q.factors if source.v is None else source.v.from_si(v)
            values[rows] = np.hstack([source.q.from_si(q), v])
    return pd.DataFrame(values, index=frame.index, columns=names)


def _along(
    model: Predictor, source: LogSource, runs: list[Recording], step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return clock ``(S,)`` s, times ``(T,)`` s and predicted states ``(K, T, 2N)`` of K runs."""
    samples = (model.fixed_step or step) / step
    if round(samples) < 1 or abs(samples - round(samples)) > 1e-3 * samples:
        raise ValueError(
            f"{runs[0].place}: the model predicts in steps of {model.fixed_step:g} s, no multiple "
            f"of the sample time, {step:g} s: give rows at the rate of the training"
        )
    clock = torch.arange(len(runs[0]), dtype=torch.float64) * step
    times = clock[:: round(samples)]
    starts = [np.hstack([run.q[0], run.v[0]]) for run in runs if run.v is not None]
    signal = Signal(
        clock, torch.from_numpy(np.stack([run.u for run in runs])), source.interpolation
    )
    states = model.predict(torch.from_numpy(np.stack(starts)), times, signal)
    return clock.numpy(), times.numpy(), states.numpy()
