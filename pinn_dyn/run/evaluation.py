"""Comparison of trained models on trajectories that no training saw."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from torch.nn.utils import vector_to_parameters

from pinn_dyn.data import DataSource, LogSource, Splits, data_changes, data_identity
from pinn_dyn.data.bandwidth import too_long_for
from pinn_dyn.evaluation import Entry, Evaluation, build_baselines, evaluate_models
from pinn_dyn.evaluation.prediction import common_stride, default_windows
from pinn_dyn.evaluation.tables import model_names
from pinn_dyn.identification.constants import read_constants
from pinn_dyn.mechanics import double_copy, stack_until
from pinn_dyn.progress import Progress
from pinn_dyn.run.configuration.validation import ConfigError
from pinn_dyn.run.run import Run
from pinn_dyn.run.run_folder import flattened, require_same_data
from pinn_dyn.training.least_squares import IDENTIFICATION

log = logging.getLogger(__name__)

LONGEST = 5.0
"""Default horizon of longer trajectories, s."""
THRESHOLDS = {"small": 0.01, "large": 0.1}
"""Thresholds of the valid prediction times, in the units of q."""
_COLUMNS = ("pairs", "parameters", "training_seconds", "processor_seconds")


def evaluate(
    runs: Run | Sequence[Run],
    *,
    source: DataSource | None = None,
    split: str = "test",
    horizon: float | None = None,
    step: float | None = None,
    windows: Sequence[float] | None = None,
    thresholds: Mapping[str, float] = THRESHOLDS,
) -> Evaluation:
    """Compare trained models on the same test trajectories, beside the baselines::

        evaluation = pinn_dyn.evaluate([pinn_dyn.load("runs/lnn"), pinn_dyn.load("runs/mlp")])
        print(evaluation)  # evaluation.summary is a data frame
        evaluation.save("results")

    Args:
        runs: loaded runs that were trained on the same data.
        source: another data set to test on; None takes the data of the training.
        split: ``test``, or ``validation`` for choosing settings.
        horizon: length of the rollouts, s; None takes the shortest trajectory, 5 s at most.
        step: step of the rollouts and between the compared times, s; None takes the training step
            of each run.
        windows: times between two resets to the measured state, s, one windowed error each; None
            takes those of 0.1, 0.5 and 1 s that fit.
        thresholds: names and values of the valid prediction times, in the units of q.

    Raises:
        ValueError: if the runs were trained on different data, if the data have changed since, or
            if the settings do not fit the data.
    """
    runs = [runs] if isinstance(runs, Run) else list(runs)
    shared: dict[str, DataSource] = {}
    sources = [shared.setdefault(str(run.config["dataset"]), run.source) for run in runs]
    _require_comparable(runs, sources, source, split)
    source = source or sources[0]
    splits = {item: item.load() for item in {*sources, source}}
    motions = getattr(splits[source], split)
    horizon = horizon or min(stack_until(motions).duration, LONGEST)
    truth = stack_until(motions, horizon)
    if shorter := len(motions) - len(truth.q):
        text = "%d of %d trajectories of %s are shorter than horizon=%g and left out"
        log.warning(text, shorter, len(motions), source.name, horizon)
    steps = [run.model.fixed_step or step or run.statistics.step for run in runs]
    if message := too_long_for(motions, max(steps), source.labels):
        log.warning("%s: %s", source.name, message)
    stride = common_stride(steps if step is None else [*steps, step], truth.t)
    grid = stride * truth.duration / (len(truth.t) - 1)

    models = model_names([run.config["model_name"] for run in runs], [run.config for run in runs])
    names = _run_names(runs, models)
    entries = [
        Entry(
            name,
            run.model,
            splits[trained_on],
            own_step,
            model,
            seed=run.config["seed"],
            figures=_figures_of(run),
            members=run.ensemble,
        )
        for name, model, run, trained_on, own_step in zip(
            names, models, runs, sources, steps, strict=True
        )
    ]
    with Progress("evaluation", len(runs), "models") as progress:
        progress.update(0, ", now the baselines")
        training = splits[sources[0]]
        predictors = build_baselines(training.train, training.validation, step=grid)
        baselines = [Entry(name, x, training, grid, name) for name, x in predictors.items()]
        baselines += _identifications(runs, models, [splits[x] for x in sources], steps)
        evaluation = evaluate_models(
            entries,
            baselines,
            source,
            truth,
            split=split,
            stride=stride,
            windows=default_windows(horizon, grid) if windows is None else windows,
            thresholds=thresholds,
            progress=progress,
        )
    folders = {name: run.folder for name, run in zip(names, runs, strict=True)}
    evaluation.constants = read_constants(folders)
    return evaluation


def _identifications(
    runs: Sequence[Run], models: Sequence[str], data: Sequence[Splits], steps: Sequence[float]
) -> list[Entry]:
    """Return the identified constants of fits that went on to rollouts, once for each model."""
    entries: dict[str, Entry] = {}
    for model, run, splits, step in zip(models, runs, data, steps, strict=True):
        name = f"identification of {model}"
        z = None if run.metrics.get("stage") == IDENTIFICATION else run.identified
        if z is not None and name not in entries:
            identified = double_copy(run.model)
            vector_to_parameters(z.double(), identified.parameters())
            entries[name] = Entry(name, identified, splits, step, name)
    return list(entries.values())


def _figures_of(run: Run) -> dict[str, Any]:
    return {k: run.metrics[k] for k in _COLUMNS if k in run.metrics} | {"folder": str(run.folder)}


def _require_comparable(
    runs: Sequence[Run], sources: Sequence[DataSource], source: DataSource | None, split: str
) -> None:
    """Refuse runs whose data have changed, and runs of different data or other robots."""
    for run, trained_on in zip(runs, sources, strict=True):
        require_same_data(run.folder, run.data, trained_on.name, data_identity(trained_on))
        if source is None:
            _require_same_test(run, runs[0], split)
        else:
            _require_fitting_test(run, trained_on, source)


def _run_names(runs: Sequence[Run], models: Sequence[str]) -> list[str]:
    """Return the names of models, with the seed and the folder of single runs where needed."""
    names, seeds = list(models), [f" seed {run.config['seed']}" for run in runs]
    for suffixes in (seeds, [f" {run.folder.name}" for run in runs]):
        if len(set(names)) < len(names):
            parts = zip(names, suffixes, runs, strict=True)
            names = [x if len(run.members) > 1 else x + y for x, y, run in parts]
    return names


def _require_same_test(run: Run, first: Run, split: str) -> None:
    ours, theirs = ({split: x.data[split]} if x.data else {} for x in (run, first))
    if data_changes(theirs, ours):
        settings = flattened(run.config["dataset"]).items()
        before = flattened(first.config["dataset"])
        differences = {key: x for key, x in settings if before.get(key) != x}
        raise ConfigError(
            f"runs: {run.folder} has another data set in {split} than {first.folder}: "
            f"{differences}: evaluate them separately, or all on one data set, dataset=<name>"
        )


def _require_fitting_test(run: Run, trained_on: DataSource, source: DataSource) -> None:
    sizes, expected = ((len(x.labels), len(x.input_labels)) for x in (source, trained_on))
    if sizes != expected:
        raise ConfigError(
            f"dataset: {source.name} has {sizes[0]} coordinates and {sizes[1]} inputs, "
            f"{run.folder} was trained on {expected[0]} and {expected[1]}"
        )
    if run.log and isinstance(source, LogSource) and run.log.cleaning != source.cleaning:
        log.warning("%s was trained with other steps than those of %s", run.folder, source.name)
