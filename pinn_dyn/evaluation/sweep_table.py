"""Sweeps: what varied among runs, and what each choice reached over its seeds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import pandas as pd

from pinn_dyn.evaluation.tables import format_table

Cell = str | int | float | bool

# Sections that are chosen as a whole have a name of their own.
_SECTION_NAMES = {"model": "model_name", "dataset": "dataset.name"}
_DRAW = "search.draw"
_WITHOUT_SPREAD = ("steps", "pairs", "parameters", "diverged")
_SHOWN = (
    "val/error_mean",
    "val/diverged",
    "test/error_mean",
    "test/diverged",
    "training_seconds",
    "steps",
    "pairs",
    "parameters",
)


def flatten(config: dict, prefix: str = "") -> dict[str, Cell]:
    """Nested sections as dotted keys.

    A class path (``_target_``) becomes the name of the class, a list its text, None ``null``.
    """
    flat: dict[str, Cell] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            flat |= flatten(value, f"{name}.")
        elif value is None:
            flat[name] = "null"
        elif key == "_target_":
            flat[name] = str(value).rsplit(".", 1)[-1]
        else:
            flat[name] = value if isinstance(value, (bool, int, float, str)) else str(value)
    return flat


def varied_parameters(
    configs: list[dict[str, Cell]], derived: Iterable[str] = frozenset()
) -> list[str]:
    """The keys that tell configurations apart, names of models and data sets first.

    Left out are ``seed``, the derived keys, and within a section (a model, one of its heads) what
    the name or the class of the section already says: of runs of two models only ``model_name``
    is left, not the sizes of networks that the other model does not have. So it is with the draws
    of a search (:class:`pinn_dyn.app.search.EqualSearch`), whose number says what was drawn.

    Args:
        configs: flattened configurations.
        derived: keys, or sections, that follow from another key, as ``data.seed: ${seed}`` does.
    """
    names = [name for name in _SECTION_NAMES.values() if _varies(name, configs)]
    found = dict.fromkeys([*names, *(key for config in configs for key in config)])
    left_out = {"seed", *derived} - set(names)
    varied = [
        key for key in found if not left_out & {key, *_sections(key)} and _varies(key, configs)
    ]
    told = [
        key
        for key in varied
        if not any(by in varied and _says([by], key, configs) for by in _names_above(key))
    ]
    if _DRAW not in told:
        return told
    by = [*names, _DRAW]
    return [key for key in told if key in by or not _says(by, key, configs)]


def runs_table(
    names: list[str],
    configs: list[dict[str, Cell]],
    metrics: list[dict[str, float]],
    parameters: list[str],
) -> pd.DataFrame:
    """One row per run: run, the parameters (empty where a run has no such key), seed, metrics.

    Of runs with the same parameters and seed the last one counts.

    Args:
        names: of the runs, one at least.
        configs: their flattened configurations; runs that differ in the seed alone are replicates.
        metrics: what they reached, such as ``val/error_mean`` and ``training_seconds``.
        parameters: keys of the configurations.
    """
    chosen = {
        name: pd.Series([config.get(name) for config in configs], dtype=object)
        for name in parameters
    }
    seeds = [config["seed"] for config in configs]
    frame = pd.DataFrame({"run": names, **chosen, "seed": seeds}).join(pd.DataFrame(metrics))
    return frame.drop_duplicates([*parameters, "seed"], keep="last", ignore_index=True)


def sweep_table(runs: pd.DataFrame, parameters: list[str], *, sort: str) -> pd.DataFrame:
    """One row per choice of the parameters: mean and sample standard deviation over its seeds.

    A metric x keeps its name for the mean and adds ``x_std``, empty for a single seed. Runs
    without a figure (no test error, say) do not count in it; an infinite one makes the mean
    infinite and leaves the spread empty.

    Args:
        runs: what ``runs_table`` returns.
        parameters: the columns that tell choices apart.
        sort: the column to sort by, smallest first.

    Raises:
        ValueError: if there is no column ``sort``.
    """
    metrics = list(runs.columns[list(runs.columns).index("seed") + 1 :])
    rows = []
    groups = runs.groupby(parameters, sort=False, dropna=False) if parameters else [((), runs)]
    for _, group in groups:
        row: dict[str, object] = {name: group[name].iloc[0] for name in parameters}
        row["seeds"] = len(group)
        for name in metrics:
            row[name] = group[name].mean()
            if not name.endswith(_WITHOUT_SPREAD):
                finite = group[name].abs().max() < math.inf
                row[f"{name}_std"] = group[name].std() if finite else math.nan
        rows.append(row)
    table = pd.DataFrame(rows).astype(dict.fromkeys(parameters, object))
    if sort not in table:
        raise ValueError(f"sort is '{sort}', expected one of {', '.join(table.columns)}")
    return table.sort_values(sort, key=_sortable, kind="stable", ignore_index=True)


def told_apart(parameters: list[str], configs: list[dict[str, Cell]]) -> list[str]:
    """The parameters without those that the model or the data set alone decides.

    Experiments come with settings of their own: of a table of three experiments the model says it
    all, and the length of their training need not stand beside it.
    """
    names = [name for name in _SECTION_NAMES.values() if name in parameters]
    return [
        key
        for key in parameters
        if key in names or not any(_says([name], key, configs) for name in names)
    ]


def sweep_text(table: pd.DataFrame, parameters: list[str]) -> str:
    """The table as aligned text, figures as mean ± standard deviation, the best marked ``*``.

    Args:
        table: what ``sweep_table`` returns.
        parameters: the parameters to show.
    """
    shown = table[[*parameters, "seeds"]].copy()
    for name in parameters:
        shown[name] = ["-" if pd.isna(value) else short(value) for value in shown[name]]
    for name in (name for name in _SHOWN if name in table):
        if name.endswith("diverged") and not table[name].any():
            continue
        shown[name] = table[name]
        if name.endswith("error_mean") and table[f"{name}_std"].notna().any():
            # format_table knows a spread by this name.
            shown[f"{name.removesuffix('mean')}std"] = table[f"{name}_std"]
    return format_table(shown)


def short(value: Cell) -> str:
    """A value as text of at most 40 characters, for the terminal."""
    text = str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _varies(key: str, configs: list[dict[str, Cell]]) -> bool:
    return len({_value(config, key) for config in configs}) > 1


def _says(by: list[str], key: str, configs: list[dict[str, Cell]]) -> bool:
    """Whether the values of some keys decide the value of another."""
    pairs = {(tuple(_value(c, name) for name in by), _value(c, key)) for c in configs}
    return len(pairs) == len({first for first, _ in pairs})


def _value(config: dict[str, Cell], key: str) -> tuple[bool, Cell | None]:
    """What tells values apart: 10 is 10.0 but 1 is not True, and a missing key counts as one."""
    value = config.get(key)
    return isinstance(value, bool), value


def _sections(key: str) -> Iterator[str]:
    """The sections that a key lies in: ``a`` and ``a.b`` for ``a.b.c``."""
    parts = key.split(".")
    return (".".join(parts[:end]) for end in range(1, len(parts)))


def _names_above(key: str) -> list[str]:
    """The keys that name the sections a key lies in."""
    names = [_SECTION_NAMES.get(key.split(".")[0]), *(f"{s}._target_" for s in _sections(key))]
    return [name for name in names if name is not None and name != key]


def _sortable(column: pd.Series) -> pd.Series:
    numbers = pd.to_numeric(column, errors="coerce")
    return column.astype(str) if (numbers.isna() & column.notna()).any() else numbers
