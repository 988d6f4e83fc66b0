"""Identification by inverse dynamics alone: the baseline of fits that add roll-outs."""

from __future__ import annotations

import logging
from collections.abc import Sequence

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
        The models, by the index of the first run of each.
    """
    settings = {}
    for k, run in enumerate(runs):
        if run.covariance is not None and run.config.get("start_from") is None:
            optimizer = {**run.config["optimizer"], "rollouts": False}
            settings[k] = run.config["model"], optimizer, run.data and run.data["train"]["hashes"]
    seen = [x for k, x in settings.items() if not runs[k].config["optimizer"].get("rollouts", True)]
    models = {}
    for k, (_, optimizer, _) in settings.items():
        if settings[k] in seen:
            continue
        seen.append(settings[k])
        run, source = runs[k], sources[k]
        models[k] = build_model(run.config, run.statistics)
        windows = build_data(run.config, source).windows
        try:
            build_part("optimizer", optimizer).fit(models[k], source.load().train, windows)
        except ValueError as error:
            log.warning("no row 'identification' of %s: %s", run.folder, error)
            del models[k]
    return models
