"""The data that runs are compared on: one truth, and the inputs as each run had them prepared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pinn_dyn.app.build import build_source
from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.run_folder import Run
from pinn_dyn.app.settings import flatten
from pinn_dyn.data import DataSource, LogSource, Splits
from pinn_dyn.data.logs import common_motions
from pinn_dyn.mechanics import Trajectory

# Keys of a data set that say how its signals are prepared, and how long the pieces are.
_SETTINGS = ("u", "input_labels", "interpolation", "shortest")
_PREPARATION = ("steps", *_SETTINGS, "validation.piece", "test.piece")


@dataclass(frozen=True)
class RunData:
    """What one run is evaluated on.

    Attributes:
        trained_on: its own data set.
        training: the splits of that.
        source: the data set of the truth, one for all runs.
        trajectories: the motions of the truth under the inputs as the run knows them.
        preparation: what is different from the data set of the truth, such as ``with delay``; ""
            where nothing is.
    """

    trained_on: DataSource
    training: Splits
    source: DataSource
    trajectories: list[Trajectory]
    preparation: str


def shared_data(runs: Sequence[Run], config: dict[str, Any]) -> list[RunData]:
    """The data of each run.

    Data sets of the same files, coordinates and splits may differ in how they were prepared. The
    truth and the times are then those of the highest rate, of the first run among equals.

    Raises:
        ConfigError: if data sets differ in more than that, or another one is named to test on that
            does not fit.
        ValueError: on data that cannot be used.
    """
    datasets: list[dict[str, Any]] = []
    sources: list[DataSource] = []
    which = []
    for run in runs:
        dataset = {key: value for key, value in run.config["dataset"].items() if key != "cache"}
        if dataset not in datasets:
            source = build_source(run.config)
            prepared = _PREPARATION if isinstance(source, LogSource) else ()
            _require_same_motions(run, runs[0], prepared)
            datasets.append(dataset)
            sources.append(source)
        which.append(datasets.index(dataset))
    splits = [source.load() for source in sources]
    first = min(range(len(sources)), key=lambda k: float(splits[k].train[0].t.diff()[0]))
    source = sources[first]
    if config.get("dataset"):
        source = build_source(config)
        _require_alone(source, sources)
        motions = [getattr(source.load(), config["split"])]
    elif len(sources) == 1:
        motions = [getattr(splits[0], config["split"])]
    else:
        order = [first, *(k for k in range(len(sources)) if k != first)]
        logs = [x for k in order if isinstance(x := sources[k], LogSource)]
        found = dict(zip(order, common_motions(logs, config["split"]), strict=True))
        motions = [found[k] for k in range(len(sources))]
    names: list[str] = []
    for dataset in datasets:
        name = _differences(dataset, datasets[first])
        again = sum(other.split(" (")[0] == name for other in names)
        names.append(f"{name} ({again + 1})" if name and again else name)
    return [RunData(sources[k], splits[k], source, motions[k], names[k]) for k in which]


def _require_same_motions(run: Run, first: Run, preparation: Sequence[str]) -> None:
    """Refuse a run whose data differ from those of another by more than their preparation."""
    here, there = (flatten({**one.config["dataset"], "cache": None}) for one in (run, first))
    different = [
        key
        for key in {**here, **there}
        if here.get(key) != there.get(key)
        and not key.startswith(tuple(f"{part}." for part in preparation))
        and key not in preparation
    ]
    if different:
        key = different[0]
        more = f", and {len(different) - 1} more" if len(different) > 1 else ""
        raise ConfigError(
            f"runs: {run.folder} was trained on another data set than {first.folder} "
            f"(dataset.{key} is {here.get(key, 'absent')}, there {there.get(key, 'absent')}{more})"
            ": evaluate them separately"
        )


def _require_alone(source: DataSource, trained_on: Sequence[DataSource]) -> None:
    """Refuse another data set to test on that has other sizes, or where inputs differ by run."""
    if len(trained_on) > 1:
        raise ConfigError(
            "dataset: the inputs of the runs were prepared in different ways, expected one way "
            "where another data set is named: evaluate them separately"
        )
    sizes = [len(source.labels), len(source.input_labels)]
    expected = [len(trained_on[0].labels), len(trained_on[0].input_labels)]
    if sizes != expected:
        raise ConfigError(
            f"dataset: {source.name} has {sizes[0]} coordinates and {sizes[1]} inputs, the runs "
            f"were trained on {expected[0]} and {expected[1]}"
        )


def _differences(dataset: dict[str, Any], truth: dict[str, Any]) -> str:
    """In a few words how a data set is prepared otherwise than that of the truth."""
    here, there = (
        {**{k: one.get(k) for k in _SETTINGS}, **(one.get("steps") or {})}
        for one in (dataset, truth)
    )
    words = []
    for key in {**there, **here}:
        own, other = here.get(key), there.get(key)
        if own != other:
            how = "with" if other is None else "without" if own is None else "other"
            words.append(f"{how} {key}")
    return ", ".join(words)
