"""Tables over runs: what differs between runs, means over seeds, the best entries, CSV files."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from pinn_dyn.atomic_files import write_whole

MAX_COLUMNS = 9  # of a summary on a page and in the terminal; the CSV file has all
SEEDS_COLUMNS = {
    "model": "model",
    "seeds": "seeds",
    "error_mean": "mean error ± std over seeds",
    "error_worst": "worst trajectory ± std over seeds",
}
_LOWER_IS_BETTER = r".*(error_(mean|median|worst)|diverged|torque_(error|share))"
_NAMES = ["dataset.name", "model_name"]
_WINDOW = r"window_(.*)s_error_mean"
_HEADERS = {
    "run": "run",
    "error_mean": "mean error ± std",
    "validation_error_mean": "validation",
    "error_worst": "worst trajectory",
    "diverged": "diverged",
    "left_data": "left the data",
    "valid_time_.*": "valid time [s]",
    _WINDOW: r"error, reset every \1 s",
    "torque_share": "torque error / spread",
    "residual_share": "residual force, share",
    r"window_([\d.]*)s_within(_corrected)?": r"errors in 95 % interval, reset every \1 s",
    "pairs": "training pairs",
    "processor_seconds": "processor [s]",
}


def varied_settings(configs: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return the settings in which runs differ, one row per run and one dotted column per setting.

    Keys that contain the seed or follow an earlier key or the names of model and data set are left
    out.
    """
    settings = pd.json_normalize(list(configs)).map(short)
    text = settings.map(str)
    names = [name for name in _NAMES if name in text and text[name].nunique() > 1]
    partitions: set[tuple[int, ...]] = set()
    columns: list[str] = []
    for column in [*names, *text.columns.difference(names, sort=False)]:
        partition = tuple(pd.factorize(text[column])[0])
        if column in ("seed", "dataset.cache") or max(partition) == 0 or partition in partitions:
            continue
        pairs = zip(text["seed"], f"{column}=" + text[column], strict=True)
        if all(re.search(rf"seed\W?{seed}(?!\d)", x) for seed, x in pairs):
            continue
        if names and column not in names and text.groupby(names)[column].nunique().max() == 1:
            continue
        partitions.add(partition)
        columns.append(column)
    return settings[columns]


def short(setting: Any) -> Any:
    """Return the text of a URDF as its name and the first digits of its hash, others unchanged."""
    if not isinstance(setting, str) or not setting.lstrip().startswith("<"):
        return setting
    name = re.match("<!-- (.*?) -->", setting)
    digits = hashlib.sha256(setting.encode()).hexdigest()[:8]
    return f"{name[1] if name else 'URDF text'} {digits}"


def model_names(names: Sequence[str], configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a name for each run: its model, and the settings in which its runs differ."""
    settings = varied_settings(configs)
    labels = []
    for name, (_, row) in zip(names, settings.iterrows(), strict=True):
        same = settings[[label == name for label in names]].map(str)
        varied = [key for key in same if same[key].nunique() > 1]
        differing = [f"{key}={row[key]}" for key, is_set in row[varied].notna().items() if is_set]
        labels.append(" ".join([name, *differing]))
    return labels


def over_seeds(runs: pd.DataFrame, by: Sequence[str]) -> pd.DataFrame:
    """Return one row per configuration, in order of appearance: means over its seeds.

    ``seeds`` is the number of runs. A figure x keeps its name for the mean, and ``x_std`` is the
    sample standard deviation: missing for a single seed, and if the mean is infinite. The columns
    ``by`` tell configurations apart.
    """
    left_out = ["seed", "worst_trajectory", "error_std", *by]
    figures = runs.select_dtypes("number").columns.difference(left_out, sort=False)
    groups = runs.groupby(list(by) or (lambda _: 0), sort=False, dropna=False)
    table = groups.size().rename("seeds").to_frame()
    for name in figures:
        table[name] = groups[name].mean()
        table[f"{name}_std"] = groups[name].std(ddof=1).where(table[name].abs() < math.inf)
    return table.reset_index(drop=not by)


def summary_columns(summary: pd.DataFrame) -> dict[str, str]:
    """Return the columns of a summary that a page and the terminal show, with their headings.

    Columns without information are left out, as a count of diverged rollouts that is 0. The longest
    window and the largest threshold are shown.
    """
    headers = {}
    for pattern, header in _HEADERS.items():
        names = [name for name in summary if re.fullmatch(pattern, name)]
        column = summary[names[-1]] if names else pd.Series()
        if (column.notna() & (column != 0)).any():
            headers[names[-1]] = re.sub(pattern, header, names[-1])
    return dict(list(headers.items())[:MAX_COLUMNS])


def formatted(
    frame: pd.DataFrame, headers: Mapping[str, str] | None = None, star: str = ""
) -> pd.DataFrame:
    """Return a table as text under its headings, numbers with three significant digits.

    A mean is followed by ± and its standard deviation. The number of diverged trajectories, which
    an error leaves out, follows, or replaces an infinite error. Names of baselines are in brackets.

    Args:
        frame: table.
        headers: columns to show and their headings; None shows all columns under their names.
        star: mark behind the best entry of each column.
    """
    text = {}
    for name, header in (headers or {name: str(name) for name in frame}).items():
        column = frame[name].map(number)
        deviation = f"{name}_std"
        if name == "error_mean" and deviation not in frame:
            deviation = "error_std"
        if deviation in frame:
            column += frame[deviation].map(lambda x: "" if pd.isna(x) else f" ± {number(x)}")
        diverged = _diverged(name)
        if diverged in frame:
            lost = frame[diverged].map(number)
            if "trajectories" in frame:
                lost += " of " + frame["trajectories"].map(number)
            lost = lost.where(frame[diverged] > 0)
            column = column.mask(frame[name] == math.inf, "diverged: " + lost.fillna("all"))
            column += (" (diverged: " + lost + ")").where(frame[name] < math.inf).fillna("")
        if star:
            column += best(frame, name).map({True: star, False: ""})
        if name in ("run", "model") and "baseline" in frame:
            column = column.where(~frame["baseline"], "[" + column + "]")
        text[header] = column
    return pd.DataFrame(text)


def to_text(frame: pd.DataFrame, headers: Mapping[str, str] | None = None) -> str:
    """Return a table for the terminal; a star marks the best entry of each column."""
    text = formatted(frame, headers, star="*")
    return text.set_index(text.columns[0]).rename_axis(None).to_string()


def number(value: object) -> str:
    """Return a number as text with three significant digits; "-" if it is missing."""
    if value is None or value is pd.NA or value != value:
        return "-"
    if isinstance(value, float):
        return f"{value:.0f}" if 1e3 <= abs(value) < 1e7 else f"{value:.3g}"
    return str(value)


def best(frame: pd.DataFrame, name: str) -> pd.Series:
    """Return the rows with the best entry of a column, bool.

    Among errors, only rows without diverged trajectories compete, since a mean leaves these out.
    No row is best unless it beats all baselines.
    """
    none = pd.Series(False, index=frame.index)
    valid_time = "valid_time_" in name
    if not (valid_time or re.fullmatch(_LOWER_IS_BETTER, name)) or frame[name].nunique() < 2:
        return none
    figures = competing(frame, name) * (-1 if valid_time else 1)
    baseline = frame["baseline"].astype(bool) if "baseline" in frame else none
    smallest = figures[~baseline].min()
    if not math.isfinite(smallest) or (figures[baseline] <= smallest).any():
        return none
    return (figures == smallest) & ~baseline


def competing(frame: pd.DataFrame, name: str) -> pd.Series:
    """Return a column of numbers, an error as infinite where trajectories diverged."""
    figures, diverged = frame[name].astype(float), _diverged(name)
    if diverged in frame:
        return figures.where(~(frame[diverged] > 0), math.inf)
    return figures


def _diverged(name: str) -> str:
    prefix, separator, _ = name.rpartition("error_")
    return f"{prefix}diverged" if separator else ""


def unbeaten_baselines(summary: pd.DataFrame) -> list[str]:
    """Return a sentence for each error in which a baseline is as accurate as all models."""
    lines, baseline = [], summary["baseline"].astype(bool)
    for name in (x for x in summary if re.fullmatch(f"error_mean|{_WINDOW}", x)):
        figures = competing(summary, name)
        bar = figures[baseline].min()
        if bar < math.inf and not figures[~baseline].min() < bar:
            row = summary.loc[figures[baseline].idxmin()]
            lines.append(
                f"No model is more accurate than the baseline '{row['run']}': {name} "
                f"{number(row[name])}."
            )
    return lines


def preferred_run(summary: pd.DataFrame) -> list[str]:
    """Return a sentence about the run with the smallest error on the validation data, if known."""
    if "validation_error_mean" not in summary:
        return []
    row = summary.loc[summary["validation_error_mean"].idxmin()]
    error = number(row["validation_error_mean"])
    return [f"The validation data prefer '{row['run']}': validation_error_mean {error}."]


def write_table(frame: pd.DataFrame, folder: Path, stem: str) -> Path:
    """Write a table as ``<stem>.csv``, and create its folder."""
    path = Path(folder) / f"{stem}.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, frame.to_csv(index=False))
    return path


def units(labels: Sequence[str]) -> str:
    """Return the units of labels such as ``Δx [rad]`` or ``q1 (rad)``, without repetition."""
    matches = [re.search(r"[\[(]([^\[\]()]+)[\])]\s*$", label) for label in labels]
    return ", ".join(dict.fromkeys(match[1] for match in matches if match))


def with_unit(text: str, labels: Sequence[str]) -> str:
    """Append the units of the labels to a text."""
    unit = units(labels)
    return f"{text} [{unit}]" if unit else text
