"""Data that runs are compared on: one truth, with the inputs as each run had them prepared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.run import Run
from pinn_dyn.app.run_folder import flattened
from pinn_dyn.data import DataSource, LogSource, Splits, data_changes
from pinn_dyn.data.logs import common_motions
from pinn_dyn.mechanics import Trajectory

# Keys of a log's data set that prepare its signals, and set the length of the pieces.
_PREPARATION = ("steps", "u", "input_labels", "interpolation", "shortest")
_PIECES = ("validation.piece", "test.piece")


@dataclass(frozen=True)
class RunData:
    """Data that one run is evaluated on.

    Attributes:
        trained_on: its own data set.
        training: the splits of that.
        source: the data set of the truth, one for all runs.
        trajectories: the motions of the truth under the inputs that the run knows.
        preparation: differences from the data set of the truth, such as ``with delay``; "" if
            there are none.
    """

    trained_on: DataSource
    training: Splits
    source: DataSource
    trajectories: list[Trajectory]
    preparation: str


def shared_data(
    runs: Sequence[Run], split: str, test_source: DataSource | None = None
) -> list[RunData]:
    """Return the data of each run.

    Data sets of the same files, coordinates and splits may differ in their preparation. The truth
    and the times are then those of the highest rate, of the first run among equals.

    Raises:
        ConfigError: if data sets differ in more than that, or ``test_source`` has other
            coordinates or inputs.
        ValueError: on data that cannot be used.
    """
    distinct: list[Run] = []  # a run of each data set
    indices = []
    for run in runs:
        matches = [k for k, earlier in enumerate(distinct) if _same_data(run, earlier)]
        k = matches[0] if matches else len(distinct)
        if not matches:
            if distinct:
                _require_same_motions(run, distinct[0])
            distinct.append(run)
        indices.append(k)
    sources = [run.source for run in distinct]
    splits = [source.load() for source in sources]
    first = min(range(len(distinct)), key=lambda k: float(splits[k].train[0].t.diff()[0]))
    source = sources[first]
    if test_source is not None:
        source = test_source
        _require_alone(source, sources)
        motions = [getattr(source.load(), split)]
    elif len(sources) == 1:
        motions = [getattr(splits[0], split)]
    else:
        order = [first, *(k for k in range(len(sources)) if k != first)]
        logs = [x for k in order if isinstance(x := sources[k], LogSource)]
        common = dict(zip(order, common_motions(logs, split), strict=True))
        motions = [common[k] for k in range(len(sources))]
    names: list[str] = []
    for run in distinct:
        name = _differences(run.config["dataset"], distinct[first].config["dataset"])
        count = sum(earlier.split(" (")[0] == name for earlier in names)
        names.append(f"{name} ({count + 1})" if name and count else name)
    return [RunData(sources[k], splits[k], source, motions[k], names[k]) for k in indices]


def _same_data(run: Run, second: Run) -> bool:
    ours, theirs = (
        {key: x for key, x in item.config["dataset"].items() if key != "path"}
        for item in (run, second)
    )
    stored = str(ours.get("_target_")).endswith(".StoredSource")
    return ours == theirs and not (stored and data_changes(run.data, second.data))


def _require_same_motions(run: Run, first: Run) -> None:
    """Refuse a run whose data differ from those of another by more than their preparation."""
    ours, theirs = (flattened(x.config["dataset"]) for x in (run, first))
    prepared = isinstance(run.source, LogSource) and isinstance(first.source, LogSource)
    differences = [
        key
        for key in dict.fromkeys([*ours, *theirs])
        if ours.get(key) != theirs.get(key)
        and not (prepared and (key.split(".")[0] in _PREPARATION or key in _PIECES))
    ]
    if differences:
        key, more = differences[0], len(differences) - 1
        raise ConfigError(
            f"runs: {run.folder} was trained on another data set than {first.folder} "
            f"(dataset.{key} is {ours.get(key, 'absent')}, there {theirs.get(key, 'absent')}"
            f"{f', and {more} more' if more else ''}): evaluate them separately"
        )


def _require_alone(source: DataSource, trained_on: Sequence[DataSource]) -> None:
    """Refuse another data set to test on that has other sizes, or if inputs differ by run."""
    if len(trained_on) > 1:
        raise ConfigError(
            "dataset: the inputs of the runs were prepared in different ways, expected one way "
            "if another data set is named: evaluate them separately"
        )
    sizes, expected = (
        (len(item.labels), len(item.input_labels)) for item in (source, trained_on[0])
    )
    if sizes != expected:
        raise ConfigError(
            f"dataset: {source.name} has {sizes[0]} coordinates and {sizes[1]} inputs, the runs "
            f"were trained on {expected[0]} and {expected[1]}"
        )


def _differences(dataset: Mapping[str, Any], truth: Mapping[str, Any]) -> str:
    """Describe in a few words how a data set is prepared differently from that of the truth."""
    ours, theirs = (
        {**{k: x.get(k) for k in _PREPARATION[1:]}, **(x.get("steps") or {})}
        for x in (dataset, truth)
    )
    texts = []
    for key in {**theirs, **ours}:
        before, after = theirs.get(key), ours.get(key)
        if before != after:
            word = "with" if before is None else "without" if after is None else "other"
            texts.append(f"{word} {key}")
    return ", ".join(texts)
