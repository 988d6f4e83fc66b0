"""Tables over runs: one row per run, one row per model, on the terminal and in files."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

# A column is recognized by how its name ends, so that prefixes (windowed_, mean_) may be added.
_LOWER_IS_BETTER = (
    "squared_error_mean",
    "error_first_half",
    "error_second_half",
    "error_mean",
    "error_median",
    "error_worst",
    "diverged",
)
_HIGHER_IS_BETTER = "valid_time_"
_NOT_AVERAGED = ("worst_trajectory", "error_std", "squared_error_variance")
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
    """What one run reached.

    Attributes:
        run: name of the run.
        model: name of the model; runs of one model differ by their seed.
        seed: seed of the run.
        metrics: named figures, such as ``RolloutMetrics.to_dict()``.
        extra: what else belongs in the row: training pairs, training seconds, parameters.
    """

    run: str
    model: str
    seed: int
    metrics: dict[str, float]
    extra: dict[str, float] = field(default_factory=dict)


def summary_table(results: list[RunResult]) -> pd.DataFrame:
    """One row per run: run, model, seed, the extras, the metrics.

    Raises:
        ValueError: on an empty list, or a name that is an extra and a metric at once.
    """
    if not results:
        raise ValueError("results is empty: expected at least one run")
    for result in results:
        twice = {"run", "model", "seed"} & (result.metrics.keys() | result.extra.keys())
        twice |= result.metrics.keys() & result.extra.keys()
        if twice:
            raise ValueError(f"run {result.run!r} names {sorted(twice)} twice: rename one of each")
    extras = list(dict.fromkeys(name for result in results for name in result.extra))
    metrics = list(dict.fromkeys(name for result in results for name in result.metrics))
    rows = [
        {"run": r.run, "model": r.model, "seed": r.seed, **r.extra, **r.metrics} for r in results
    ]
    return pd.DataFrame(rows, columns=["run", "model", "seed", *extras, *metrics])


def grouped_table(summary: pd.DataFrame) -> pd.DataFrame:
    """One row per model, in order of appearance: mean and worst over its seeds.

    A metric x becomes ``mean_x`` and ``worst_x``; other numbers only get their mean. The worst is
    the largest error or the shortest valid time. A mean over a diverged seed may be infinite.
    """
    rows = []
    for model, group in summary.groupby("model", sort=False):
        row: dict[str, object] = {"model": model, "seeds": len(group)}
        for column in summary.columns:
            # Neither an index nor a spread over times has a meaning when averaged over seeds.
            if column == "seed" or column.endswith(_NOT_AVERAGED):
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


def format_table(frame: pd.DataFrame) -> str:
    """The table as aligned text, the best figure of a column marked with ``*``.

    Among errors only runs with the fewest diverged trajectories compete, since the mean leaves
    the diverged ones out. The mean of a run comes as mean ± standard deviation over its times and
    trajectories; the squared errors, the halves of the horizon and the like are in the files only.
    """
    shown = [name for name in frame.columns if not name.endswith(_ONLY_IN_FILES)]
    texts = [_column_text(frame, name) for name in shown]
    widths = [max(map(len, [name, *text])) for name, text in zip(shown, texts, strict=True)]
    left = [not pd.api.types.is_numeric_dtype(frame[name]) for name in shown]

    def line(cells: list[str]) -> str:
        padded = [
            cell.ljust(width) if is_left else cell.rjust(width)
            for cell, width, is_left in zip(cells, widths, left, strict=True)
        ]
        return "  ".join(padded).rstrip()

    rows = [line(list(cells)) for cells in zip(*texts, strict=True)]
    return "\n".join([line(shown), "  ".join("-" * width for width in widths), *rows])


def write_table(frame: pd.DataFrame, folder: Path, stem: str) -> tuple[Path, Path]:
    """Write ``<stem>.csv`` and ``<stem>.json`` (a list of records); returns both paths.

    JSON knows no infinity: an infinite figure is the string "inf" there, a missing one null.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    csv, records = folder / f"{stem}.csv", folder / f"{stem}.json"
    frame.to_csv(csv, index=False)
    rows = [
        {name: _json_value(value) for name, value in row.items()}
        for row in frame.astype(object).to_dict(orient="records")
    ]
    records.write_text(json.dumps(rows, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return csv, records


def _json_value(value: object) -> object:
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
    best = _best(frame, name)
    ranked = best.any()
    cells = []
    for index, value in enumerate(frame[name]):
        text = _number(value)
        if spread is not None:
            text += f" ± {_number(spread.iloc[index])}"
        cells.append(text + ("*" if best.iloc[index] else " " if ranked else ""))
    return cells


def _best(frame: pd.DataFrame, name: str) -> pd.Series:
    """Which rows hold the best figure of a column; none if the column does not tell rows apart."""
    none = pd.Series(False, index=frame.index)
    rank = _rank(name)
    if rank == 0 or frame[name].nunique() < 2:
        return none
    figures = rank * frame[name].astype(float)
    suffix = next((end for end in _LOWER_IS_BETTER if rank > 0 and name.endswith(end)), None)
    diverged = None if suffix is None else name.removesuffix(suffix) + "diverged"
    if diverged in frame.columns:
        figures = figures.where(frame[diverged] == frame[diverged].min(), math.inf)
    smallest = figures.min()
    return figures == smallest if math.isfinite(smallest) else none


def _number(value: object) -> str:
    if isinstance(value, float):
        if math.isnan(value):
            return "-"
        return f"{value:.0f}" if 1e3 <= abs(value) < 1e7 else f"{value:.3g}"
    return str(value)
