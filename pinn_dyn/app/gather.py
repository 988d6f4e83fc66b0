"""One table of many runs: what varied, and the errors over seeds, as gather.py makes it."""

from __future__ import annotations

import glob
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pinn_dyn.app.config import ConfigError, checked
from pinn_dyn.app.run_folder import CONFIG, METRICS
from pinn_dyn.app.sweep import ERROR, first_line
from pinn_dyn.evaluation import (
    over_seeds,
    save,
    sweep_figure,
    to_text,
    varied_settings,
    write_table,
)
from pinn_dyn.spelling import did_you_mean

log = logging.getLogger(__name__)

_EVALUATIONS = "runs/evaluation/*"
_RECORDED = ("training_seconds", "steps", "pairs", "parameters")
_COUNTS = ("val/diverged", "test/diverged")
_SHOWN = ("val/error_mean", "val/diverged", "test/error_mean", "test/diverged", "training_seconds")


def read_runs(patterns: Sequence[str] | str) -> tuple[pd.DataFrame, list[dict], dict[str, str]]:
    """Read all runs in folders and below them.

    Args:
        patterns: run folders, folders of them, or globs.

    Returns:
        One row per finished run (folder, seed, ``val/`` errors, training time and sizes), the
        configuration of each of them, and the problems of the other jobs by folder.
    """
    rows, configs, problems = {}, [], {}
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        roots = [Path(path) for path in sorted(glob.glob(str(Path(pattern).expanduser())))]
        files = [f for root in roots for name in (CONFIG, ERROR) for f in root.rglob(name)]
        folders = {f.parent for f in files if f.is_file() and f.parent.name != ".hydra"}
        for folder in sorted(folders - set(rows) - {Path(path) for path in problems}):
            try:
                config = yaml.safe_load((folder / CONFIG).read_text())
                if "trainer" not in config:
                    continue  # the results of another command
                if not (folder / METRICS).is_file():
                    raise FileNotFoundError("it has not finished")
                record = json.loads((folder / METRICS).read_text())
                rows[folder] = {
                    "folder": str(folder),
                    "seed": config["seed"],
                    **{key: record[key] for key in _RECORDED if key in record},
                    **{k: v for k, v in record["validation"].items() if k.startswith("val/")},
                }
                configs.append(config)
            except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError) as error:
                failed = (folder / ERROR).is_file()
                text = first_line(folder / ERROR) if failed else f"no result: {error}"
                problems[str(folder)] = text
    return pd.DataFrame(rows.values()), configs, problems


def filtered(settings: pd.DataFrame, conditions: Mapping[str, Any]) -> pd.Series:
    """Return which runs have the values of all conditions, bool; a list means any of its values.

    Raises:
        ConfigError: if no run has a key, or no run meets the conditions.
    """
    chosen = pd.Series(True, index=settings.index)
    for key, value in conditions.items():
        if key not in settings:
            raise ConfigError(
                f"filter: the runs have no key '{key}'{did_you_mean(key, list(settings))}"
            )
        values = value if isinstance(value, list) else [value]
        chosen &= settings[key].map(str).isin(map(str, values))
    if not chosen.any():
        raise ConfigError(f"filter: no run has {dict(conditions)}")
    return chosen


def test_errors(folders: Sequence[str], patterns: Sequence[str] | None) -> pd.DataFrame:
    """Return the test errors of runs from tables of evaluate.py, indexed by folder.

    Args:
        folders: run folders.
        patterns: folders of evaluate.py, or globs; None takes the latest evaluation of these runs.

    Raises:
        ConfigError: if the evaluations have different horizons, so that errors do not compare.
    """
    searched = patterns or [_EVALUATIONS]
    paths = [Path(p, "summary.csv") for pattern in searched for p in glob.glob(pattern)]
    paths = [path for path in paths if path.is_file()]
    tables = []
    for path in sorted(paths, key=lambda path: -path.stat().st_mtime):
        try:
            table = pd.read_csv(path)
        except ValueError as error:
            log.warning("left out: %s cannot be read: %s", path, error)
            continue
        if "folder" in table and (matches := table["folder"].isin(folders)).any():
            tables.append(table[matches])
            if patterns is None:
                break
    if not tables:
        if patterns:
            raise ConfigError(f"evaluations: {patterns} have no results of these runs")
        return pd.DataFrame(index=pd.Index([], name="folder"))
    table = pd.concat(tables).drop_duplicates("folder").set_index("folder")
    if table["horizon"].nunique() > 1:
        raise ConfigError(f"evaluations: horizons differ: {sorted(set(table['horizon']))} s")
    names = [
        n for n in table if n.endswith(("error_mean", "error_median", "error_worst", "diverged"))
    ]
    return table[names].add_prefix("test/")


def gather(cfg: DictConfig) -> None:
    """Write and print the table of runs, and draw an error against a setting.

    Raises:
        ConfigError: if there is no run, or a column does not exist.
    """
    config = checked("gather", cfg)
    folder = Path(HydraConfig.get().runtime.output_dir)
    runs, configs, problems = read_runs(config["runs"])
    if not (len(runs) or problems):
        raise ConfigError(f"runs: {config['runs']} lead to no run of train.py")
    if len(runs):
        chosen = filtered(pd.json_normalize(configs), config["filter"] or {})
        runs = runs[chosen]
        settings = varied_settings([configs[k] for k in chosen.to_numpy().nonzero()[0]])
        runs = runs.join(settings.set_index(runs.index))
        runs = runs.join(test_errors([*runs["folder"]], config["evaluations"]), on="folder")
        repeated = runs.duplicated([*settings, "seed"], keep="last")
        runs = runs[~repeated]
        table = over_seeds(runs, [*settings])
        for key in ("sort", "plot", "plot_column"):
            if config[key] not in (None, *runs, *table):
                raise ConfigError(f"{key} is '{config[key]}', expected one of {', '.join(runs)}")
        table = table.sort_values(config["sort"], kind="stable", ignore_index=True)
        write_table(runs, folder, "runs")
        write_table(table, folder, "sweep")
        figures = [k for k in _SHOWN if k in table and (k not in _COUNTS or table[k].any())]
        shown = [*settings, "seeds", *figures]
        print(f"\n{len(runs)} runs: mean ± standard deviation over seeds")
        print(to_text(table, {name: name for name in shown}))
        if config["plot"] is not None:
            lines = [name for name in settings if name != config["plot"]]
            figure = sweep_figure(runs, x=config["plot"], lines=lines, y=config["plot_column"])
            save(figure, folder / "sweep.png")
        if repeated.any():
            print(f"\nleft out: {repeated.sum()} runs that were repeated with the same seed")
        print(f"\ntables are in {folder}")
    if problems:
        print(f"\n{len(problems)} jobs have no result:")
        print("\n".join(f"  {path}\n    {text}" for path, text in problems.items()))
