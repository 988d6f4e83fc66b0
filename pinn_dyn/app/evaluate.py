"""The command evaluate.py."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pinn_dyn.app.config import checked
from pinn_dyn.run.configuration.build import ConfigError, build_source
from pinn_dyn.run.configuration.trust import packages
from pinn_dyn.run.evaluation import evaluate
from pinn_dyn.run.provenance import write_provenance
from pinn_dyn.run.run import Run, ensemble
from pinn_dyn.run.run_folder import CONFIG, flattened, load_run

_SEEDS = ("seed", "data.seed")


def main(cfg: DictConfig) -> float:
    """Evaluate the runs of a configuration, write the results, and return the smallest mean error.

    Runs that cannot be loaded are left out and named at the end.
    """
    config = checked("evaluate", cfg)
    folder = Path(HydraConfig.get().runtime.output_dir)
    torch.set_num_threads(config["threads"])
    patterns = [config["runs"]] if isinstance(config["runs"], str) else config["runs"]
    paths: list[Path] = []
    for pattern in patterns:
        matches = [Path(path) for path in sorted(glob.glob(str(Path(pattern).expanduser())))]
        matches = [path for path in matches if (path / CONFIG).is_file()]
        if not matches:
            raise ConfigError(f"runs: '{pattern}' matches no run folder (no {CONFIG})")
        paths += matches
    runs, errors = [], []
    for path in dict.fromkeys(paths):
        try:
            runs.append(load_run(path, config["checkpoint"], packages(config.get("trust"))))
        except Exception as error:  # a file that is cut short raises nearly anything
            errors.append(f"{path}: {error}")
    failure = f"{len(errors)} runs cannot be loaded:\n  " + "\n  ".join(errors)
    if not runs:
        raise ConfigError(failure)
    keys = ("split", "horizon", "step", "windows", "thresholds")
    try:
        source = build_source(config) if config.get("dataset") else None
        if config["ensemble"]:
            runs += _ensembles(runs)
        evaluation = evaluate(runs, source=source, **{key: config[key] for key in keys})
    except ValueError as error:
        raise ConfigError(str(error)) from error
    by_name = dict(zip(evaluation.summary["run"], runs, strict=False))
    beside = {"dataset": runs[0].config["dataset"]}
    evaluation.origin = write_provenance(by_name, evaluation.source, config, beside, folder)
    evaluation.save(folder, config["trajectory"])
    print(f"\n{evaluation}\n\nfigures and tables are in {folder}; open report.html in a browser")
    if errors:
        raise ConfigError(failure)
    summary = evaluation.summary
    return float(summary["error_mean"][~summary["baseline"]].min())


def _ensembles(runs: Sequence[Run]) -> list[Run]:
    """Return the mean of all runs that differ in their seeds alone, for each such group."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        settings = {k: x for k, x in flattened(run.config).items() if k not in _SEEDS}
        groups.setdefault(repr(settings), []).append(run)
    means = [ensemble(group) for group in groups.values() if len(group) > 1]
    if not means:
        raise ConfigError("ensemble: no two runs differ in the seed alone: add runs of other seeds")
    return means
