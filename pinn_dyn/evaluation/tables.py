"""Tables over runs: one row per run, one row per model, on the terminal and in files."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from pinn_dyn.data.whole import write_whole

# A column is recognized by how its name ends, so that prefixes (windowed_, mean_) may be added.
_LOWER_IS_BETTER = (
    "squared_error_mean",
    "error_first_half",
    "error_second_half",
    "error_mean",
    "error_median",
    "error_worst",
    "torque_error",
    "torque_share",
    "diverged",
)
_HIGHER_IS_BETTER = "valid_time_"
_NOT_AVERAGED = ("worst_trajectory", "error_std", "squared_error_variance")
_COUNTS = ("diverged", "left_data", "left_data_after")  # say nothing where nothing went wrong
_ONLY_IN_FILES = (
    "squared_error_mean",
    "squared_error_variance",
    "error_first_half",
    "error_second_half",
    "error_std",
    "worst_trajectory",
    "trajectories",
    "horizon",
)


@dataclass(frozen=True)
class RunResult:
    """What one run reached, or a floor.

    Attributes:
        run: name of the run.
        model: name of the model; runs of one model differ by their seed.
        seed: seed of the run; None for a floor.
        metrics: named figures, such as ``RolloutMetrics.to_dict()``.
        extra: what else belongs in the row: training pairs, training seconds, parameters.
        floor: whether this is no trained model but what one has to beat.
    """

    run: str
    model: str
    seed: int | None
    metrics: dict[str, float]
    extra: dict[str, float] = field(default_factory=dict)
    floor: bool = False


def summary_table(results: list[RunResult]) -> pd.DataFrame:
    """One row per run: run, model, seed, floor, the extras, the metrics.

    Raises:
        ValueError: on an empty list, or a name that is an extra and a metric at once.
    """
    if not results:
        raise ValueError("results is empty: expected at least one run")
    for result in results:
        twice = {"run", "model", "seed", "floor"} & (result.metrics.keys() | result.extra.keys())
        twice |= result.metrics.keys() & result.extra.keys()
        if twice:
            raise ValueError(f"run {result.run!r} names {sorted(twice)} twice: rename one of each")
    extras = list(dict.fromkeys(name for result in results for name in result.extra))
    metrics = list(dict.fromkeys(name for result in results for name in result.metrics))
    first = ("run", "model", "seed", "floor")
    rows = [{name: getattr(r, name) for name in first} | r.extra | r.metrics for r in results]
    frame = pd.DataFrame(rows, columns=[*first, *extras, *metrics])
    return frame.astype({"seed": "Int64"})  # whole numbers, although a floor has none


def grouped_table(summary: pd.DataFrame) -> pd.DataFrame:
    """One row per model, in order of appearance: mean and worst over its seeds.

    A metric x becomes ``mean_x`` and ``worst_x``; other numbers only get their mean. The worst is
    the largest error or the shortest valid time. A mean over a diverged seed may be infinite.
    """
    rows = []
    for model, group in summary.groupby("model", sort=False):
        row: dict[str, object] = {"model": model, "seeds": len(group)}
        if "floor" in group:
            row["floor"] = bool(group["floor"].iloc[0])
        for column in summary.columns:
            # Neither an index nor a spread over times has a meaning when averaged over seeds.
            if column in ("seed", "floor") or column.endswith(_NOT_AVERAGED):
                continue
            if not pd.api.types.is_numeric_dtype(summary[column]):
                continue
            row[f"mean_{column}"] = group[column].mean()
            if _rank(column) > 0:
                row[f"worst_{column}"] = group[column].max()
            elif _rank(column) < 0:
                row[f"worst_{column}"] = group[column].min()
        rows.append(row)
    return pd.DataFrame(rows)


def format_table(frame: pd.DataFrame, headers: Mapping[str, str] | None = None) -> str:
    """The table as aligned text, the best figure of a column marked with ``*``, see :func:`best`.

    The mean of a run comes as mean ± standard deviation over its times and trajectories; the
    squared errors, the halves of the horizon and the like are in the files only. A column that
    counts what went wrong is left out where nothing did. A floor has its name in brackets. Columns
    that are in ``headers`` go by another name.
    """
    frame = bracketed(frame)
    shown = [
        name
        for name in frame.columns
        if not name.endswith(("floor", *_ONLY_IN_FILES))
        and not (name.endswith(_COUNTS) and frame[name].isin([0, math.inf]).all())
    ]
    texts = [_column_text(frame, name) for name in shown]
    titles = [(headers or {}).get(name, name) for name in shown]
    widths = [max(map(len, [title, *text])) for title, text in zip(titles, texts, strict=True)]
    left = [not pd.api.types.is_numeric_dtype(frame[name]) for name in shown]

    def line(cells: list[str]) -> str:
        padded = [
            cell.ljust(width) if is_left else cell.rjust(width)
            for cell, width, is_left in zip(cells, widths, left, strict=True)
        ]
        return "  ".join(padded).rstrip()

    rows = [line(list(cells)) for cells in zip(*texts, strict=True)]
    return "\n".join([line(titles), "  ".join("-" * width for width in widths), *rows])


def bracketed(frame: pd.DataFrame) -> pd.DataFrame:
    """The same table, the names of floors in brackets."""
    if "floor" not in frame:
        return frame
    name = "run" if "run" in frame else "model"
    return frame.assign(**{name: frame[name].where(~frame["floor"], "[" + frame[name] + "]")})


def write_table(frame: pd.DataFrame, folder: Path, stem: str) -> tuple[Path, Path]:
    """Write ``<stem>.csv`` and ``<stem>.json`` (a list of records); returns both paths.

    JSON knows no infinity: an infinite figure is the string "inf" there, a missing one null.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    csv, records = folder / f"{stem}.csv", folder / f"{stem}.json"
    write_whole(csv, frame.to_csv(index=False))
    rows = [
        {name: _json_value(value) for name, value in row.items()}
        for row in frame.astype(object).to_dict(orient="records")
    ]
    write_whole(records, json.dumps(rows, indent=2, allow_nan=False) + "\n")
    return csv, records


def _json_value(value: object) -> object:
    if value is pd.NA:
        return None
    if not isinstance(value, float) or math.isfinite(value):
        return value
    return None if math.isnan(value) else str(value)


def _rank(column: str) -> int:
    """1 if a lower figure is better, -1 if a higher one is, 0 if neither."""
    if _HIGHER_IS_BETTER in column:
        return -1
    return 1 if column.endswith(_LOWER_IS_BETTER) else 0


def _column_text(frame: pd.DataFrame, name: str) -> list[str]:
    spread = None
    if name.endswith("error_mean"):
        sibling = name.removesuffix("error_mean") + "error_std"
        spread = frame[sibling] if sibling in frame.columns else None
    marks = best(frame, name)
    ranked = marks.any()
    cells = []
    for index, value in enumerate(frame[name]):
        never = name.endswith("left_data_after") and value == math.inf
        text = "never" if never else number(value)
        if spread is not None and text != "-":
            text += f" ± {number(spread.iloc[index])}"
        cells.append(text + ("*" if marks.iloc[index] else " " if ranked else ""))
    return cells


def best(frame: pd.DataFrame, name: str) -> pd.Series:
    """Which rows hold the best figure of a column.

    Among errors only rows with the fewest diverged trajectories compete, since the mean leaves
    the diverged ones out. A floor is never marked, and a model only if it beats every floor. None
    is marked in a column that does not tell rows apart.
    """
    none = pd.Series(False, index=frame.index)
    rank = _rank(name)
    if rank == 0 or frame[name].nunique() < 2:
        return none
    figures = rank * frame[name].astype(float).where(_competes(frame, name), math.inf)
    floor = frame["floor"].astype(bool) if "floor" in frame else none
    smallest = figures[~floor].min()
    if not math.isfinite(smallest) or (figures[floor] <= smallest).any():
        return none
    return (figures == smallest) & ~floor


def beaten_by_floors(frame: pd.DataFrame) -> list[str]:
    """A sentence for each error column in which no model beats every floor.

    Args:
        frame: what :func:`summary_table` returns, floors among its rows.
    """
    sentences = []
    for name in frame:
        others = ("squared_", "state_squared_", "member_")
        if not name.endswith("error_mean") or name.startswith(others):
            continue
        figures = frame[name].astype(float).where(_competes(frame, name), math.inf)
        floor = frame["floor"].astype(bool)
        if floor.any() and not figures[~floor].min() < figures[floor].min():
            lowest = frame.loc[figures[floor].idxmin()]
            sentences.append(
                f"No model beats every floor in {name}: '{lowest['run']}' has "
                f"{number(lowest[name])}."
            )
    return sentences


def best_floor(summary: pd.DataFrame) -> str | None:
    """The floor that errs least of those with the fewest diverged trajectories; None without any.

    Args:
        summary: what :func:`summary_table` returns.
    """
    floors = summary[summary["floor"].astype(bool)]
    return None if floors.empty else floors.sort_values(["diverged", "error_mean"])["run"].iloc[0]


def _competes(frame: pd.DataFrame, name: str) -> pd.Series:
    """Rows whose figure compares: of roll-out errors those with the fewest that diverged."""
    everyone = pd.Series(True, index=frame.index)
    suffix = next((end for end in _LOWER_IS_BETTER if name.endswith(end)), None)
    if suffix is None or "torque" in suffix:  # which comes without a roll-out
        return everyone
    diverged = name.removesuffix(suffix) + "diverged"
    return frame[diverged] == frame[diverged].min() if diverged in frame else everyone


def number(value: object) -> str:
    """A figure as text with three significant digits; "-" where there is none."""
    if value is pd.NA:
        return "-"
    if isinstance(value, float):
        if math.isnan(value):
            return "-"
        return f"{value:.0f}" if 1e3 <= abs(value) < 1e7 else f"{value:.3g}"
    return str(value)
