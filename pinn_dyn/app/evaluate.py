"""The command evaluate.py."""

from __future__ import annotations

import glob
import logging
from collections.abc import Sequence
from pathlib import Path

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from pinn_dyn.app.build import build_source
from pinn_dyn.app.config import ConfigError, checked
from pinn_dyn.app.evaluation import evaluate
from pinn_dyn.app.provenance import write_provenance
from pinn_dyn.app.run_folder import CONFIG, load_run
from pinn_dyn.app.trust import packages

log = logging.getLogger(__name__)


def find_runs(patterns: Sequence[str] | str) -> list[Path]:
    """Return the run folders that match paths or globs.

    Raises:
        ConfigError: if a pattern matches no run folder.
    """
    folders: dict[Path, Path] = {}
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        paths = [Path(path) for path in sorted(glob.glob(str(Path(pattern).expanduser())))]
        matches = [path for path in paths if (path / CONFIG).is_file()]
        if not matches:
            raise ConfigError(f"runs: '{pattern}' matches no run folder (no {CONFIG})")
        folders |= {path.resolve(): path for path in matches}
    if not folders:
        raise ConfigError("runs is empty, expected run folders or globs, as runs=[runs/my_arm/*]")
    return list(folders.values())


def main(cfg: DictConfig) -> float:
    """Evaluate the runs of a configuration and write the results.

    Returns:
        The smallest mean error.

    Raises:
        ConfigError: on settings that do not fit the data. Runs that cannot be loaded are left out
            and named at the end.
    """
    config = checked("evaluate", cfg)
    folder = Path(HydraConfig.get().runtime.output_dir)
    torch.set_num_threads(config["threads"])
    runs, errors = [], []
    for path in find_runs(config["runs"]):
        try:
            runs.append(load_run(path, config["checkpoint"], packages(config.get("trust"))))
        except Exception as error:  # a file that is cut short raises nearly anything
            errors.append(f"{path}: {error}")
            log.warning("left out: %s", errors[-1])
    failure = f"{len(errors)} runs cannot be loaded:\n  " + "\n  ".join(errors)
    if not runs:
        raise ConfigError(failure)
    keys = ("split", "horizon", "step", "windows", "thresholds")
    try:
        source = build_source(config) if config.get("dataset") else None
        evaluation = evaluate(runs, source=source, **{key: config[key] for key in keys})
    except ValueError as error:
        raise ConfigError(str(error)) from error
    trajectory, count = config["trajectory"], len(evaluation.truth.q)
    if not 0 <= trajectory < count:
        raise ConfigError(f"trajectory is {trajectory}, expected 0 to {count - 1}")
    by_name = dict(zip(evaluation.summary["run"], runs, strict=False))
    beside = {"dataset": runs[0].config["dataset"]}
    evaluation.origin = write_provenance(by_name, evaluation.source, config, beside, folder)
    evaluation.save(folder, trajectory)
    print(f"\n{evaluation}\n\nfigures and tables are in {folder}; open report.html in a browser")
    if errors:
        raise ConfigError(failure)
    summary = evaluation.summary
    return float(summary["error_mean"][~summary["baseline"]].min())
