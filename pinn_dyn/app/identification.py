"""Identification by inverse dynamics alone: the baseline of every fit that adds roll-outs."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import Any

from pinn_dyn.app.build import build_data, build_model
from pinn_dyn.app.config import build_part
from pinn_dyn.app.run import Run
from pinn_dyn.data import DataSource
from pinn_dyn.mechanics import Predictor

log = logging.getLogger(__name__)


def identified(runs: Sequence[Run], sources: Sequence[DataSource]) -> dict[int, Predictor]:
    """Repeat the first stage of least squares for the runs that also took the second one.

    Runs of equal settings, such as several seeds, share one model. Runs that are trained by
    ``optimizer.rollouts=false`` are such models themselves, and fits that started from an earlier
    one have no counterpart.

    Returns:
        The models, by the number of the first run that each belongs to.
    """
    fits = [
        k
        for k, run in enumerate(runs)
        if run.covariance is not None and run.config.get("start_from") is None
    ]
    settings = {k: _settings(runs[k]) for k in fits}
    seen = [settings[k] for k in fits if not runs[k].config["optimizer"].get("rollouts", True)]
    models = {}
    for k in fits:
        if settings[k] in seen:
            continue
        seen.append(settings[k])
        try:
            models[k] = _fitted(runs[k], sources[k])
        except ValueError as error:
            log.warning("no row 'identification' of %s: %s", runs[k].folder, error)
    return models


def _settings(run: Run) -> tuple[Any, ...]:
    optimizer = {key: value for key, value in run.config["optimizer"].items() if key != "rollouts"}
    return run.config["model"], optimizer, run.data and run.data["train"]["hashes"]


def _fitted(run: Run, source: DataSource) -> Predictor:
    model = build_model(run.config, run.statistics)
    solver = build_part("optimizer", {**run.config["optimizer"], "rollouts": False})
    start = time.process_time()
    windows = build_data(run.config, source).windows
    solver.fit(model, source.load().train, windows)
    log.info(
        "identification: inverse dynamics on the training motions, %.1f s of processor time",
        time.process_time() - start,
    )
    return model
