"""Gather the runs of a sweep into one table, as gather.py does."""

from __future__ import annotations

import glob
import logging
import os
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pinn_dyn.app.build import BEST_BY
from pinn_dyn.app.config import ConfigError, checked
from pinn_dyn.app.jobs import Job, derived_keys, filter_jobs, find_jobs
from pinn_dyn.evaluation import save, write_table
from pinn_dyn.evaluation.sweep_figures import sweep_figure
from pinn_dyn.evaluation.sweep_table import (
    runs_table,
    short,
    sweep_table,
    sweep_text,
    told_apart,
    varied_parameters,
)

log = logging.getLogger(__name__)

_LATEST_EVALUATIONS = "runs/evaluation/*"
_FEW = 6  # parameters beside the folder of a lost job
_RECORDED = ("training_seconds", "steps", "pairs", "parameters")
_DRAW = "search.draw"
_OVERRIDES = Path(".hydra") / "overrides.yaml"
_ERRORS = ("error_mean", "error_median", "error_worst", "diverged")


def gather(cfg: DictConfig) -> None:
    """Write and print the table of a sweep, and the figure if one is asked for.

    Raises:
        ConfigError: if no run is found or left by the filter, or a column does not exist.
    """
    config = checked("gather", cfg)
    if config["plot"] is None and config["plot_column"] != config["sort"]:
        raise ConfigError(
            "plot_column is set, but plot is null: give plot=..., what to draw against"
        )
    folder = Path(HydraConfig.get().runtime.output_dir)
    jobs = filter_jobs(find_jobs(config["runs"]), config["filter"] or {})
    finished = [job for job in jobs if job.record is not None]
    lost = [job for job in jobs if job.record is None]
    if finished:
        _report(finished, config, folder)
    else:
        print("\nno run has finished")
    if lost:
        print(f"\n{_lost_text(lost, jobs)}")
    if finished:
        print(f"\ntables are in {folder}")


def _report(jobs: list[Job], config: dict[str, Any], folder: Path) -> None:
    """Write and print the table of finished runs."""
    parameters = varied_parameters([job.config for job in jobs], derived_keys(jobs))
    tests, source = _test_figures(jobs, config["evaluations"])
    runs = runs_table(
        [str(job.folder) for job in jobs],
        [job.config for job in jobs],
        [{**_figures(job), **tests.get(job.folder, {})} for job in jobs],
        parameters,
    )
    try:
        table = sweep_table(runs, parameters, sort=config["sort"])
    except ValueError as error:
        raise ConfigError(str(error)) from error
    write_table(runs, folder, "runs")
    write_table(table, folder, "sweep")
    shown = told_apart(parameters, [job.config for job in jobs])
    print(f"\nruns: {len(runs)}, figures as mean ± standard deviation over seeds{source}")
    print(sweep_text(table, shown))
    notes = []
    if len(runs) < len(jobs):
        notes.append(
            "left out, as later runs have the same configuration and seed: "
            f"{len(jobs) - len(runs)} of {len(jobs)}"
        )
    if len(shown) < len(parameters):
        hidden = ", ".join(name for name in parameters if name not in shown)
        notes.append(f"the model or the data set decides, only in the files: {hidden}")
    if notes:
        print("\n" + "\n".join(notes))
    if draws := best_draws(jobs):
        lines = "\n".join(f"  {line}" for line in draws)
        print(f"\nbest draw of each model by {BEST_BY}, mean over seeds:\n{lines}")
    if config["plot"] is not None:
        others = [name for name in shown if name != config["plot"]]
        try:
            figure = sweep_figure(runs, x=config["plot"], lines=others, y=config["plot_column"])
        except ValueError as error:
            raise ConfigError(f"plot: {error}") from error
        save(figure, folder / "sweep.png")


def best_draws(jobs: list[Job]) -> list[str]:
    """Of each model of a search the best draw, its validation error, and the command behind it.

    Draws that diverged for one seed, and runs of no search, are none. Of equal draws the first is
    the best.
    """
    found: dict[str, dict[int, list[Job]]] = {}
    for job in jobs:
        if _DRAW in job.config:
            draws = found.setdefault(str(job.config["name"]), {})
            draws.setdefault(int(job.config[_DRAW]), []).append(job)
    lines = []
    for name, draws in found.items():
        errors = {
            draw: np.mean([_figures(job).get(BEST_BY, np.nan) for job in draws[draw]])
            for draw in sorted(draws)
        }
        finite = {draw: error for draw, error in errors.items() if np.isfinite(error)}
        if finite:
            best = min(finite, key=finite.__getitem__)
            folder = draws[best][0].folder
            lines.append(f"{name}: draw {best} has {finite[best]:.4g}: {_command(folder)}")
    return lines


def _command(folder: Path) -> str:
    """What trained a run; its folder where it does not say."""
    try:
        words = yaml.safe_load((folder / _OVERRIDES).read_text())
        return shlex.join(["python", "train.py", *words])
    except (OSError, ValueError, TypeError, yaml.YAMLError):  # it may come from anyone
        return str(folder)


def _figures(job: Job) -> dict[str, float]:
    """What the training itself recorded."""
    record = job.record or {}
    names = [*(f"val/{name}" for name in _ERRORS), BEST_BY]
    validation = record.get("validation", {})
    return {name: validation[name] for name in names if name in validation} | {
        name: record[name] for name in _RECORDED if name in record
    }


def _test_figures(
    jobs: list[Job], patterns: list[str] | str | None
) -> tuple[dict[Path, dict[str, float]], str]:
    """Test figures of the runs, and a text that says which evaluations they come from.

    Raises:
        ConfigError: if a named evaluation does not exist or knows none of the runs, or if
            evaluations differ in their horizon.
    """
    named = [patterns] if isinstance(patterns, str) else patterns
    figures: dict[Path, dict[str, float]] = {}
    horizons: dict[str, float] = {}
    for pattern in named or [_LATEST_EVALUATIONS]:
        folders = [Path(p).parent for p in glob.glob(f"{os.path.expanduser(pattern)}/summary.csv")]
        if named and not folders:
            raise ConfigError(
                f"evaluations: '{pattern}' has no summary.csv; give folders that evaluate.py wrote"
            )
        for folder in sorted(
            folders, key=lambda x: (x / "summary.csv").stat().st_mtime, reverse=True
        ):
            try:
                summary = pd.read_csv(folder / "summary.csv")
            except ValueError as error:
                log.warning("passed over: %s cannot be read: %s", folder / "summary.csv", error)
                continue
            known = {job.folder: row for job in jobs if (row := _row_of(job, summary)) is not None}
            if not known:
                continue
            # Of a run that was evaluated twice the latest counts.
            figures = {path: _test_row(row) for path, row in known.items()} | figures
            horizons[str(folder)] = float(summary["horizon"].iloc[0])
            if named is None:
                break
    if named and not figures:
        raise ConfigError(f"evaluations: none of {', '.join(named)} knows any of these runs")
    if len(set(horizons.values())) > 1:
        found = ", ".join(f"{name}: {horizon:g} s" for name, horizon in horizons.items())
        raise ConfigError(f"evaluations: their horizons differ, so errors do not compare: {found}")
    if not figures:
        return {}, ""
    return figures, (
        f"\ntest: {len(figures)} of {len(jobs)} runs over {next(iter(horizons.values())):g} s, "
        f"from {', '.join(horizons)}"
    )


def _row_of(job: Job, summary: pd.DataFrame) -> pd.Series | None:
    """A run's row of an evaluation, which names no folders: known by its seed and training time.

    The time is written with all its digits, so that no two trainings share it; a run that was
    resumed after the evaluation has another one, as it should.
    """
    seconds = (job.record or {}).get("training_seconds")
    if seconds is None or not {"seed", "training_seconds", "horizon"} <= set(summary.columns):
        return None
    same = np.isclose(summary["training_seconds"], seconds, rtol=1e-12, atol=0) & (
        summary["seed"] == job.config["seed"]
    )
    return summary[same].iloc[0] if same.any() else None


def _test_row(row: pd.Series) -> dict[str, float]:
    return {f"test/{name}": float(row[name]) for name in row.index if name.endswith(_ERRORS)}


def _lost_text(lost: list[Job], jobs: list[Job]) -> str:
    """The jobs without a result: where, with which parameters, and how they ended."""
    configs = [job.config for job in jobs]
    shown = told_apart(varied_parameters(configs, derived_keys(jobs)), configs)
    lines = [f"{len(lost)} of {len(jobs)} jobs have no result:"]
    for job in lost:
        values = [f"{name}={short(job.config[name])}" for name in shown if name in job.config]
        if len(values) > _FEW:
            values = [*values[:_FEW], "..."]
        lines += [f"  {' '.join([str(job.folder), *values])}", f"    {job.problem}"]
    return "\n".join(lines)
