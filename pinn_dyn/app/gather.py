"""The command gather.py: one table of many runs, with errors over seeds."""

from __future__ import annotations

import glob
import json
from collections.abc import Sequence
from io import StringIO
from pathlib import Path

import pandas as pd
import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from pandas.api.types import is_numeric_dtype

from pinn_dyn.app.config import checked
from pinn_dyn.app.sweep import ERROR, first_line
from pinn_dyn.atomic_files import read_regular
from pinn_dyn.evaluation import save, sweep_figure
from pinn_dyn.evaluation.tables import competing, over_seeds, to_text, varied_settings, write_table
from pinn_dyn.run.configuration.validation import ConfigError
from pinn_dyn.run.run_folder import CONFIG, METRICS

_RECORDED = ("training_seconds", "steps", "kept_step", "pairs", "parameters")
_SPLITS = ("val", "last", "test")  # the kept model on validation data, the last one, on test data
_SHOWN = [f"{split}/{name}" for split in _SPLITS for name in ("error_mean", "diverged")]
_SHOWN += ["kept_step", "training_seconds"]
_TEST = ("error_mean", "error_median", "error_worst", "diverged")


def read_runs(patterns: Sequence[str]) -> tuple[pd.DataFrame, list[dict], dict[str, str]]:
    """Return a row and the configuration of each finished run in or below folders or globs.

    The third value holds the problems of the jobs without a result, by folder.
    """
    roots = [path for x in patterns for path in glob.glob(str(Path(x).expanduser()))]
    files = [f for root in roots for name in (CONFIG, ERROR) for f in Path(root).rglob(name)]
    rows, configs, problems = [], [], {}
    for folder in sorted({f.parent for f in files if f.parent.name != ".hydra"}):
        try:
            config = yaml.safe_load(read_regular(folder / CONFIG))
            if "trainer" not in config:
                continue  # results of another command
            record = json.loads(read_regular(folder / METRICS))
            row = {"folder": str(folder), "seed": config["seed"]}
            row |= {key: record[key] for key in _RECORDED if key in record}
            row |= {k: x for k, x in record["validation"].items() if k.startswith("val/")}
            last = record.get("last_validation", {}).items()
            row |= {f"last/{k[4:]}": x for k, x in last if k.startswith("val/")}
            rows.append(row)
            configs.append(config)
        except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError) as error:
            failed = (folder / ERROR).is_file()
            problems[str(folder)] = first_line(folder / ERROR) if failed else f"no result: {error}"
    return pd.DataFrame(rows), configs, problems


def read_test_errors(folders: Sequence[str], patterns: Sequence[str]) -> pd.DataFrame:
    """Return the test errors of runs, indexed by folder, from folders of evaluate.py or globs."""
    paths = [path for x in patterns for p in glob.glob(x) for path in Path(p).glob("summary.csv")]
    paths.sort(key=lambda path: -path.stat().st_mtime)
    tables = [pd.read_csv(StringIO(read_regular(path))) for path in paths]
    table = pd.concat([x[x["folder"].isin(folders)] for x in tables]) if tables else pd.DataFrame()
    if table.empty:
        raise ConfigError(f"evaluations: {patterns} have no results of these runs")
    table = table.drop_duplicates("folder").set_index("folder")
    if table["horizon"].nunique() > 1:
        raise ConfigError(f"evaluations: horizons differ: {sorted(set(table['horizon']))} s")
    return table[[name for name in table if name.endswith(_TEST)]].add_prefix("test/")


def gather(cfg: DictConfig) -> None:
    """Write and print the table of runs, and plot an error against a setting."""
    config = checked("gather", cfg)
    folder = Path(HydraConfig.get().runtime.output_dir)
    patterns = [config["runs"]] if isinstance(config["runs"], str) else config["runs"]
    runs, configs, problems = read_runs(patterns)
    if runs.empty and not problems:
        raise ConfigError(f"runs: {config['runs']} lead to no run of train.py")
    if len(runs):
        settings = varied_settings(configs)
        runs = runs.join(settings)
        if config["evaluations"]:
            errors = read_test_errors([*runs["folder"]], config["evaluations"])
            runs = runs.join(errors, on="folder")
        repeated = runs.duplicated([*settings, "seed"], keep="last")
        runs = runs[~repeated]
        table = over_seeds(runs, [*settings])
        for key in ("sort", "plot"):
            if config[key] not in (None, *runs, *table):
                raise ConfigError(f"{key} is '{config[key]}', expected one of {', '.join(runs)}")
        order = table[config["sort"]]
        order = competing(table, config["sort"]) if is_numeric_dtype(order) else order
        table = table.loc[order.sort_values(kind="stable").index].reset_index(drop=True)
        write_table(runs, folder, "runs")
        write_table(table, folder, "sweep")
        figures = [k for k in _SHOWN if k in table and (k[-8:] != "diverged" or table[k].any())]
        shown = [*settings, "seeds", *figures]
        print(f"\nruns: {len(runs)}, mean ± standard deviation over seeds")
        print(to_text(table, {name: name for name in shown}))
        if repeated.any():
            print(f"\nleft out: {repeated.sum()} runs that were repeated with the same seed")
        if config["plot"] is not None:
            lines = [name for name in settings if name != config["plot"]]
            figure = sweep_figure(runs, x=config["plot"], lines=lines, y=config["sort"])
            save(figure, folder / "sweep.png")
        print(f"\ntables are in {folder}")
    if problems:
        print(f"\njobs without a result: {len(problems)}")
        print("\n".join(f"  {path}\n    {text}" for path, text in problems.items()))
