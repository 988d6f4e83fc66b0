"""Run folders. A checkpoint holds all about a run; YAML and JSON files are copies for people."""

from __future__ import annotations

import contextlib
import json
import logging
import pkgutil
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
import yaml
from filelock import FileLock, Timeout

from pinn_dyn import __version__
from pinn_dyn.atomic_files import save_whole, write_whole
from pinn_dyn.data import data_changes
from pinn_dyn.evaluation.tables import short
from pinn_dyn.mechanics import Predictor, double_copy
from pinn_dyn.models import Statistics
from pinn_dyn.models.cholesky import set_output_limits
from pinn_dyn.run.configuration.build import ConfigError, ModelBuilder, model_builder
from pinn_dyn.run.configuration.trust import is_trusted, packages, require_trusted
from pinn_dyn.run.run import Run
from pinn_dyn.systems import RigidChain
from pinn_dyn.systems.urdf import urdf_text
from pinn_dyn.training import COVARIANCE, FIT

CONFIG = "config.yaml"
METRICS, CHECKPOINTS = "metrics.json", "checkpoints"
RECORD, DATA, FINISHED = "record", "data", "finished"
"""Keys of a checkpoint: metrics of the training, identity of the data, end of the training."""
REPLACE = "train into another folder, or replace the run by overwrite=True"
_RESULTS = (
    CHECKPOINTS,
    "tensorboard",
    METRICS,
    "constants.csv",
    "undetermined.md",
    "residuals.png",
    "payload.csv",
)
"""Files and folders that only some trainings write."""

log = logging.getLogger(__name__)


def load(
    folder: str | Path,
    checkpoint: str = "best",
    *,
    model: ModelBuilder | None = None,
    trust: str | list[str] | tuple[str, ...] = (),
) -> Run:
    """Load the trained model of a run folder.

    Args:
        folder: the run folder.
        checkpoint: ``"best"``, of the smallest validation error, or ``"last"``.
        model: builder of the model, for a class that the checkpoint cannot name.
        trust: packages of your own whose classes the run may build, see SECURITY.md.

    Raises:
        ValueError: if the folder is no run folder, its checkpoint is damaged or of another model,
            or it names classes that are not trusted.
    """
    return load_run(Path(folder).expanduser(), checkpoint, packages(trust), model)


def load_run(
    folder: Path,
    checkpoint: str = "best",
    trust: tuple[str, ...] | None = (),
    model: ModelBuilder | None = None,
) -> Run:
    """Load a run as :func:`load` does; ``trust=None`` trusts all classes that the run names."""
    path = folder / CHECKPOINTS / f"{checkpoint}.ckpt"
    saved = read_checkpoint(path)
    config = saved["hyper_parameters"]["config"]
    if trust is not None:
        named = config if model is None else {k: x for k, x in config.items() if k != "model"}
        require_trusted(named, str(path), trust)
    record = saved.get(RECORD, {})
    if checkpoint == "last" and "last_validation" in record:
        record = {k: x for k, x in record.items() if k != "kept_step"}
        record["validation"] = record["last_validation"]
    if record and not saved.get(FINISHED):
        log.warning("%s: the training has not ended", path)
    try:
        statistics = Statistics.from_dict(saved["hyper_parameters"]["statistics"])
        with torch.random.fork_rng(devices=[]):  # models draw their initial weights
            predictor = (model or model_builder(config))(statistics=statistics)
        _load_weights(predictor, saved["state_dict"])
    except ValueError as error:
        version = record.get("pinn_dyn", __version__)
        raise ConfigError(f"{path}, made by pinn_dyn {version}: {error}") from error
    dataset, covariance = config["dataset"], saved.get(COVARIANCE)
    if str(dataset.get("_target_")).endswith(".StoredSource"):
        dataset = {**dataset, "path": str(folder / dataset["path"])}
    robot = (dataset.get("system") or {}).get("_target_")
    return Run(
        folder,
        {**config, "dataset": dataset},
        double_copy(predictor).requires_grad_(False),
        statistics,
        record,
        saved.get(DATA, {}),
        bool(saved.get(FINISHED)),
        covariance if isinstance(covariance, torch.Tensor) else None,
        saved.get(FIT, {}).get("identified"),
        _may_simulate=trust is None or is_trusted(robot, trust),
    )


def _load_weights(model: Predictor, state: Mapping[str, torch.Tensor]) -> None:
    """Load the weights of a checkpoint; refuse those of another model, and NaN."""
    weights = {k.removeprefix("model."): x for k, x in state.items() if k.startswith("model.")}
    set_output_limits(model, weights)
    if broken := [key for key, value in weights.items() if not value.isfinite().all()]:
        raise ConfigError(f"the weights {broken[0]} are NaN or infinite, the training diverged")
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:
        raise ConfigError(f"weights of another model: {in_one_line(error)}") from error


def in_one_line(error: Exception) -> str:
    """Return the beginning of an error message in one line."""
    return " ".join(str(error).split())[:300] or type(error).__name__


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint: tensors and plain values, no code; refuse a damaged file."""
    if not path.is_file():
        names = ", ".join(sorted(file.stem for file in path.parent.glob("*.ckpt")))
        kind = f"{path.parent} has {names}" if names else "this is no run folder"
        raise ConfigError(f"{path} does not exist: {kind}")
    try:
        with zipfile.ZipFile(path) as archive:
            if damaged := archive.testzip():  # torch.load does not compare the checksums
                raise zipfile.BadZipFile(f"{damaged} has another checksum")
        saved = torch.load(path, map_location="cpu", weights_only=True)
        saved["hyper_parameters"]["config"]["dataset"].pop("cache", None)  # each user has their own
        saved["state_dict"].items()
    except Exception as error:  # a damaged archive or pickle raises nearly anything
        text = f"{path} cannot be read, it may be cut short: {in_one_line(error)}"
        raise ConfigError(text) from error
    return saved


def newest_checkpoint(folder: Path) -> tuple[Path | None, dict[str, Any]]:
    """Return the last checkpoint of a training, or the best one if the last is damaged."""
    for name in ("last", "best"):
        path = folder / CHECKPOINTS / f"{name}.ckpt"
        try:
            return path, read_checkpoint(path)
        except ConfigError as error:
            if path.is_file():
                log.warning("%s", error)
    return None, {}


def finish(folder: Path, record: dict[str, Any]) -> dict[str, Any]:
    """Write the record of a training that has ended into its checkpoints, and a copy beside.

    ``record`` is that of the last step. The result has the step and the metrics of the best
    checkpoint, ``kept_step`` and ``validation``, beside ``last_validation``.
    """
    paths = [folder / CHECKPOINTS / f"{name}.ckpt" for name in ("best", "last")]
    saved = [torch.load(path, map_location="cpu", weights_only=True) for path in paths]
    kept = {"kept_step": saved[0]["global_step"], "validation": saved[0][RECORD]["validation"]}
    record = {**record, "last_validation": record["validation"], **kept}
    for path, content in zip(paths, saved, strict=True):
        save_whole(path, {**content, RECORD: record, FINISHED: True})
    write_whole(folder / METRICS, json.dumps(record, indent=2))
    return record


def require_same_data(
    folder: Path, before: Mapping[str, Any], name: str, now: Mapping[str, Any], advice: str = ""
) -> None:
    """Refuse data that have changed since a training: test motions may have moved."""
    if changes := data_changes(before, now) if before else []:
        more = [f"and {len(changes) - 10} more"] if len(changes) > 10 else []
        text = "\n  ".join([*changes[:10], *more, *filter(None, [advice])])
        raise ConfigError(f"{name} has changed since {folder} was trained:\n  {text}")


def with_structures(part: Any) -> Any:
    """Replace the path of each URDF in a configuration by its text, so that a run contains it."""
    if isinstance(part, list):
        return [with_structures(item) for item in part]
    if not isinstance(part, Mapping):
        return part
    part = {key: with_structures(value) for key, value in part.items()}
    if {"_target_", "urdf"} <= part.keys():
        target = pkgutil.resolve_name(part["_target_"])
        if isinstance(target, type) and issubclass(target, RigidChain):
            part["urdf"] = urdf_text(part["urdf"])
    return part


def merged(config: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a nested configuration with some of its values replaced."""
    result = dict(config)
    for key, value in changes.items():
        is_section = isinstance(value, Mapping)
        result[key] = merged(result[key], value) if is_section else value
    return result


def require_no_links_out(folder: Path) -> None:
    """Refuse a run folder of others with links through which a training would write elsewhere."""
    for path in folder.rglob("*"):
        if path.is_symlink() and not path.resolve().is_relative_to(folder.resolve()):
            raise ConfigError(
                f"{path} is a link to {path.resolve()}: nothing is written outside of the run "
                "folder, expected a file or folder: replace the link by a copy"
            )


@contextlib.contextmanager
def claimed(
    folder: Path, config: dict[str, Any], overwrite: bool = False
) -> Iterator[tuple[Path | None, dict[str, Any]]]:
    """Lock a run folder for a configuration; yield path and content of its newest checkpoint.

    Refuse a folder that another process locks, or with a training of another configuration, which
    ``overwrite`` deletes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / ".lock", timeout=0):
            for partial in folder.rglob("*.partial"):  # of a process that was killed while writing
                partial.unlink(missing_ok=True)
            for result in [folder / name for name in _RESULTS if overwrite]:
                if result.is_dir():
                    shutil.rmtree(result)
                else:
                    result.unlink(missing_ok=True)
            path, saved = newest_checkpoint(folder)
            if saved:
                _require_same_config(folder, saved["hyper_parameters"]["config"], config)
            write_config(folder, config)
            if saved.get(FINISHED):
                write_whole(folder / METRICS, json.dumps(saved[RECORD], indent=2))
            yield path, saved
    except Timeout as error:
        raise ConfigError(f"{folder} is in use: another process trains there") from error


def _require_same_config(folder: Path, before: dict[str, Any], now: dict[str, Any]) -> None:
    ours, theirs = flattened(now), flattened(before)
    ours.pop("dataset.cache", None)
    differences = [
        f"{key}={ours.get(key)} (there {theirs.get(key)})"
        for key in dict.fromkeys([*ours, *theirs])
        if ours.get(key) != theirs.get(key)
    ]
    if differences:
        text = ", ".join(differences[:5])
        raise ConfigError(f"{folder} holds a training of another configuration: {text}: {REPLACE}")


def flattened(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested sections as dotted keys, and the text of a URDF as its name and hash."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        section = isinstance(value, Mapping) and value
        flat |= flattened(value, f"{prefix}{key}.") if section else {f"{prefix}{key}": short(value)}
    return flat


def write_config(folder: Path, config: dict[str, Any]) -> None:
    """Write the resolved configuration of a run."""
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / CONFIG, yaml.safe_dump(config, sort_keys=False, allow_unicode=True))
