"""A data frame as a log: its file, its configuration, and a split and a length that fit it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from pinn_dyn.data.logs import Columns, LogError
from pinn_dyn.data.logs import columns as log_columns
from pinn_dyn.data.logs.table import Table
from pinn_dyn.data.whole import whole, write_whole

Signals = str | Sequence[str] | Mapping[str, Any]

FRAME = "frame.csv"
_WHOLE_RUNS = 5  # from so many on some are kept whole for validation and test
_SHARE = 0.15  # of the runs, or of each run, for the test, and again for validation
_PIECE = 5.0  # s, the longest roll-out of validation and test
_GUARD = 0.5  # s, at most, between training, validation and test of one run
_HORIZON = 2.0  # s, at most, of the roll-outs by which the best checkpoint is chosen
_PAIRS, _BATCH = 10000, 128  # at most, as data=multi_step
_STEPS, _STEP = 2, 0.02  # of a training window: so many steps, each of about so many s


def frame_dataset(
    frame: pd.DataFrame, signals: Mapping[str, Signals], run: str | None, seed: int, folder: Path
) -> list[str]:
    """Write a frame and ``dataset/frame.yaml`` to a folder; returns the overrides that use them.

    Args:
        frame: the log.
        signals: columns of time, q, u and, where there is one, v.
        run: column that tells runs apart, or None.
        seed: of the choice of runs.
        folder: the run folder.

    Raises:
        LogError: on columns that are not there or hold no numbers, or too few rows.
    """
    if run is not None and not isinstance(run, str):
        raise LogError(f"run is {run!r}, expected the name of a column, or None")
    described = {name: _described(name, given) for name, given in signals.items()}
    columns = {
        name: log_columns.described(Columns, name, given) for name, given in described.items()
    }
    table = Table(frame, "the frame")
    values = {name: table.numbers(x.columns, name) for name, x in columns.items()}
    if not len(frame):
        raise LogError("the frame has no rows, expected a log")
    t = columns["time"].to_si(values["time"])[:, 0]
    ids = ["frame"] * len(frame) if run is None else table.column(run, "run")
    if pd.isna(np.asarray(ids)).any():
        raise LogError(f"the frame, column '{run}' (run): some rows belong to no run, give it")
    runs = {str(key): x.to_numpy() for key, x in pd.Series(t).groupby(np.asarray(ids), sort=False)}

    folder.mkdir(parents=True, exist_ok=True)
    with whole(folder / FRAME) as partial:
        frame.to_csv(partial, index=False)
    split, settings = _split(runs, seed)
    dataset = {
        "defaults": ["csv_log", "_self_"],
        "name": "frame",
        "root": str(folder),
        "files": FRAME,
        "trajectory": run,
        **described,
        **split,
    }
    group = folder / "dataset"
    group.mkdir(exist_ok=True)
    write_whole(
        group / "frame.yaml",
        yaml.safe_dump(dataset, sort_keys=False, allow_unicode=True, default_flow_style=None),
    )
    place = str(folder).replace("\\", "\\\\").replace("'", "\\'")
    return [
        f"hydra.searchpath=['file://{place}']",
        "dataset=frame",
        "data=multi_step",
        *(f"{key}={value}" for key, value in settings.items()),
    ]


def in_frame(said: str, frame: pd.DataFrame, folder: Path) -> str:
    """What an error says of a line in the written file, as of a row by the index of the frame."""
    return re.sub(
        rf"{re.escape(str(folder / FRAME))}, line (\d+)",
        lambda line: f"the frame, row {frame.index[int(line[1]) - 2]}",
        said,
    )


def _described(name: str, given: Signals) -> dict[str, Any]:
    """A signal as a configuration has it; names alone have SI units."""
    if isinstance(given, (bytes, Set)) or not isinstance(given, Iterable):
        raise LogError(f"{name} is {given!r}, expected names of columns, as ['{name}1', '{name}2']")
    if not isinstance(given, Mapping):
        given = {"columns": given, "unit": {"time": "s", "v": "1/s"}.get(name, "1")}
    plain = {key: _plain(value) for key, value in given.items()}
    columns = plain.get("columns")
    for one in [columns] if isinstance(columns, str) else columns or ():
        if not isinstance(one, str) or "${" in one or one == "???":  # of a configuration
            raise LogError(f"{name} names the column {one!r}, expected a text without '${{'")
    return plain


def _plain(value: Any) -> Any:
    """A value of Python and YAML, also of what NumPy or pandas holds."""
    if isinstance(value, str) or value is None:
        return value
    return np.asarray(list(value) if isinstance(value, Iterable) else value).tolist()


def _split(runs: dict[str, np.ndarray], seed: int) -> tuple[dict[str, Any], dict[str, float]]:
    """Validation and test of a data set, and the windows and roll-outs that fit it.

    Of five runs or more, 15 % are the test and as many the validation, whole, drawn among those of
    at least the median length. Of fewer, the ends of each: all in pieces of at most 5 s.

    Args:
        runs: times of each run, s.
        seed: of the choice.
    """
    spacing = np.concatenate([np.diff(t) for t in runs.values()])
    step = float(np.median(spacing[spacing > 0])) if (spacing > 0).any() else 1.0
    lengths = {name: float(np.ptp(t)) for name, t in runs.items()}

    def piece(longest: float) -> float:
        """At most so long, and a multiple of the sample time."""
        return round(max(int(min(_PIECE, longest) / step + 1e-6), 1) * step, 9)

    if len(runs) >= _WHOLE_RUNS:
        median = float(np.median([*lengths.values()]))
        long = [name for name, length in lengths.items() if length >= median - 0.5 * step]
        count = max(round(_SHARE * len(runs)), 1)
        drawn = [long[k] for k in np.random.default_rng(seed).permutation(len(long))]
        test, validation = sorted(drawn[:count]), sorted(drawn[count : 2 * count])
        size = piece(median)
        split: dict[str, Any] = {
            "validation": {"runs": validation, "piece": size},
            "test": {"runs": test, "piece": size},
        }
        rows = [len(t) for name, t in runs.items() if name not in [*test, *validation]]
    else:
        shortest = min(lengths.values())
        seconds, guard = piece(_SHARE * shortest), min(_GUARD, 0.02 * shortest)
        seconds = max(_SHARE * shortest, seconds)
        size = piece(seconds)
        split = {
            "validation": {"seconds": seconds, "piece": size},
            "test": {"seconds": seconds, "piece": size},
            "guard": guard,
        }
        kept = 2 * (seconds + guard) / step + 2
        rows = [int(len(t) - kept) for t in runs.values()]
    stride = max(round(_STEP / step), 1)
    starts = sum(max(count - _STEPS * stride, 0) for count in rows)
    pairs = max(min(_PAIRS, starts), 1)
    return split, {
        "data.steps": _STEPS,
        "data.stride": stride,
        "data.pairs": pairs,
        "data.batch_size": min(_BATCH, pairs),
        "validator.horizon": min(_HORIZON, size),
    }
