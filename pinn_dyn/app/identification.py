"""What inverse dynamics alone find: the rival of every fit that goes on with roll-outs."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import Any

from pinn_dyn.app.build import build_data, build_model
from pinn_dyn.app.parts import build_part
from pinn_dyn.app.run_folder import Run
from pinn_dyn.app.shared_data import RunData
from pinn_dyn.mechanics import Predictor

log = logging.getLogger(__name__)


def identified(runs: Sequence[Run], data: Sequence[RunData]) -> dict[int, Predictor]:
    """The first stage of least squares, fitted again for the runs that took the second one too.

    Runs that are alike in all that counts there, as those of several seeds, share one. It is left
    out where it stands among the runs, which ``optimizer.rollouts=false`` trains.

    Returns:
        The models, by the number of the first run that each belongs to.
    """
    # An earlier fit is another start, which these constants do not have.
    fits = [
        k
        for k, run in enumerate(runs)
        if run.covariance is not None and run.config.get("start_from") is None
    ]
    alone = [k for k in fits if not runs[k].config["optimizer"].get("rollouts", True)]
    seen = [_settings(runs[k], data[k]) for k in alone]
    found = {}
    for k in fits:
        settings = _settings(runs[k], data[k])
        if settings in seen:
            continue
        seen.append(settings)
        try:
            found[k] = _fitted(runs[k], data[k])
        except ValueError as error:
            log.warning("no row 'identification' of %s: %s", runs[k].folder, error)
    return found


def _settings(run: Run, data: RunData) -> tuple[Any, ...]:
    """What the first stage depends on."""
    optimizer = {key: value for key, value in run.config["optimizer"].items() if key != "rollouts"}
    return run.config["model"], optimizer, data.preparation


def _fitted(run: Run, data: RunData) -> Predictor:
    model = build_model(run.config, run.statistics)
    solver = build_part("optimizer", {**run.config["optimizer"], "rollouts": False})
    start = time.process_time()
    windows = build_data(run.config, data.trained_on).windows
    solver.fit(model, data.training.train, windows)
    took = time.process_time() - start
    log.info(
        "identification: inverse dynamics on the training motions, %.1f s of processor time", took
    )
    return model
