"""Data that runs are compared on."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.run import Run
from pinn_dyn.app.run_folder import check_data, flattened
from pinn_dyn.data import DataSource, LogSource, data_changes

log = logging.getLogger(__name__)


def training_sources(runs: Sequence[Run]) -> list[DataSource]:
    """Return the data set that each run was trained on; runs of equal settings share it.

    Raises:
        ConfigError: if data have changed since a training.
    """
    shared: dict[str, DataSource] = {}
    sources = [shared.setdefault(str(run.config["dataset"]), run.source) for run in runs]
    for run, source in zip(runs, sources, strict=True):
        check_data(run, source)
    return sources


def require_same_test(run: Run, first: Run, split: str) -> None:
    """Refuse a run whose data of a split differ from those of the first run."""
    ours, theirs = ({split: x.data[split]} if x.data else {} for x in (run, first))
    if data_changes(theirs, ours):
        settings, others = (flattened(x.config["dataset"]) for x in (run, first))
        keys = [key for key in {**others, **settings} if settings.get(key) != others.get(key)]
        differences = [f"{key}={settings.get(key)} ({others.get(key)})" for key in keys]
        raise ConfigError(
            f"runs: {run.folder} has another data set in {split} than {first.folder}: "
            f"{', '.join(differences)}: evaluate them separately"
        )


def require_fitting_test(run: Run, trained_on: DataSource, source: DataSource) -> None:
    """Refuse a data set to test on that has other coordinates or inputs than that of a run."""
    sizes, expected = ((len(x.labels), len(x.input_labels)) for x in (source, trained_on))
    if sizes != expected:
        raise ConfigError(
            f"dataset: {source.name} has {sizes[0]} coordinates and {sizes[1]} inputs, "
            f"{run.folder} was trained on {expected[0]} and {expected[1]}"
        )
    if run.log and isinstance(source, LogSource) and run.log.steps != source.steps:
        log.warning("%s was trained with other steps than those of %s", run.folder, source.name)
