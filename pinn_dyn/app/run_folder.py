"""Run folders: layout, lock, checkpoints, and loading of trained models.

A checkpoint holds everything about a run: configuration, statistics, weights, metrics and the
identity of the data. ``config.yaml`` and ``metrics.json`` are copies for people and for tables.
"""

from __future__ import annotations

import contextlib
import json
import logging
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
import yaml
from filelock import FileLock, Timeout
from lightning.pytorch.utilities.seed import isolate_rng

from pinn_dyn import __version__
from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.run import ModelBuilder, Run
from pinn_dyn.app.trust import require_trusted
from pinn_dyn.data import DataSource, data_changes, data_identity
from pinn_dyn.data.whole import write_whole
from pinn_dyn.mechanics import Predictor, double_copy
from pinn_dyn.models import Statistics
from pinn_dyn.models.output_limits import set_output_limits
from pinn_dyn.training import COVARIANCE, WholeCheckpoints

CONFIG = "config.yaml"
METRICS = "metrics.json"
CHECKPOINTS = "checkpoints"
RECORD, DATA, FINISHED = "record", "data", "finished"
"""Keys of a checkpoint: metrics of the training, identity of the data, end of the training."""
_LOCK = ".lock"
_SHOWN = 10  # changes of the data in a message

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
        folder: run folder of train.py, :func:`~pinn_dyn.train` or :func:`~pinn_dyn.fit`.
        checkpoint: ``"best"``, of the smallest validation error, or ``"last"``.
        model: builder of the model, for a class that the checkpoint cannot name.
        trust: packages of your own whose classes the run may build, see SECURITY.md.

    Raises:
        ValueError: if the folder is no run folder, its checkpoint is damaged or of another model,
            or it names classes that are not trusted.
    """
    trusted = (trust,) if isinstance(trust, str) else tuple(trust)
    return load_run(Path(folder).expanduser(), checkpoint, trusted, model)


def load_run(
    folder: Path,
    checkpoint: str = "best",
    trust: tuple[str, ...] | None = (),
    model: ModelBuilder | None = None,
) -> Run:
    """Load a run as :func:`load` does; ``trust=None`` trusts all classes that the run names.

    Raises:
        ConfigError: as :func:`load`; names the version that made the run if it is another one.
    """
    from pinn_dyn.app.build import build_predictor, model_builder

    path = folder / CHECKPOINTS / f"{checkpoint}.ckpt"
    saved = read_checkpoint(path)
    config = saved["hyper_parameters"]["config"]
    if trust is not None:
        named = config if model is None else {k: x for k, x in config.items() if k != "model"}
        require_trusted(named, str(path), trust)
    record = saved.get(RECORD) or read_metrics(folder) or {}
    if not saved.get(FINISHED) and not (folder / METRICS).is_file():
        log.warning(
            "%s: the training has not ended, this is its %s model so far", folder, path.stem
        )
    try:
        statistics = Statistics.from_dict(saved["hyper_parameters"]["statistics"])
        with isolate_rng():  # models draw their initial weights
            predictor = build_predictor(
                model or model_builder(config), statistics, config["seed"], config["ensemble"]
            )
        _take_weights(predictor, path, saved["state_dict"])
    except ValueError as error:
        made_by = record.get("pinn_dyn", __version__)
        version = "" if made_by == __version__ else f" (made by pinn_dyn {made_by})"
        raise ConfigError(f"{path}{version}: {error}") from error
    dataset, covariance = config["dataset"], saved.get(COVARIANCE)
    if str(dataset.get("_target_")).endswith(".StoredSource"):
        dataset = {**dataset, "path": str(folder / dataset["path"])}
    return Run(
        folder,
        {**config, "dataset": dataset},
        double_copy(predictor).requires_grad_(False),
        statistics,
        record,
        saved.get(DATA, {}),
        bool(saved.get(FINISHED)),
        covariance if isinstance(covariance, torch.Tensor) else None,
    )


def _take_weights(model: Predictor, path: Path, state: Mapping[str, torch.Tensor]) -> None:
    """Give a model the weights of a checkpoint.

    Raises:
        ConfigError: if they are those of another model, or not finite.
    """
    weights = {k.removeprefix("model."): x for k, x in state.items() if k.startswith("model.")}
    set_output_limits(model, weights)
    if broken := [key for key, value in weights.items() if not value.isfinite().all()]:
        raise ConfigError(
            f"the weights {broken[0]} are NaN or infinite, the training diverged: take another "
            "checkpoint or train again with a lower optimizer.lr"
        )
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:
        raise ConfigError(f"weights of another model: {_one_line(error)}") from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint: tensors and plain values, no code.

    Raises:
        ConfigError: if it is missing, damaged, or no checkpoint of this program.
    """
    if not path.is_file():
        names = sorted(p.stem for p in path.parent.glob("*.ckpt"))
        kind = f"{path.parent} has {', '.join(names)}" if names else "this is no run folder"
        raise ConfigError(f"{path} does not exist: {kind}")
    try:
        with zipfile.ZipFile(path) as archive:
            if damaged := archive.testzip():  # torch.load does not compare the checksums
                raise zipfile.BadZipFile(f"{damaged} has another checksum")
        saved = torch.load(path, map_location="cpu", weights_only=True)
        parameters = saved["hyper_parameters"]
        if not isinstance(parameters["config"]["dataset"], dict) or "state_dict" not in saved:
            raise KeyError("state_dict")
        parameters["config"].setdefault("ensemble", 1)
        parameters["config"]["dataset"].pop("cache", None)  # each user has their own
    except Exception as error:  # a damaged archive or pickle raises nearly anything
        text = _one_line(error) or type(error).__name__
        raise ConfigError(f"{path} cannot be read, it may be cut short: {text}") from error
    return saved


def is_finished(folder: Path) -> bool:
    """Check whether the training of a folder has ended."""
    path = folder / CHECKPOINTS / "last.ckpt"
    with contextlib.suppress(ConfigError):
        return path.is_file() and bool(read_checkpoint(path).get(FINISHED))
    return False


def finish(folder: Path, record: dict[str, Any]) -> None:
    """Put the record of a training that has ended into its checkpoints, and a copy beside them."""
    for name in ("best", "last"):
        path = folder / CHECKPOINTS / f"{name}.ckpt"
        saved = torch.load(path, map_location="cpu", weights_only=True)
        WholeCheckpoints().save_checkpoint({**saved, RECORD: record, FINISHED: True}, path)
    write_json(folder / METRICS, record)


def restore_record(folder: Path) -> None:
    """Write the copy of the record anew if it is missing, after a kill at the end of a training."""
    if not (folder / METRICS).is_file():
        write_json(folder / METRICS, read_checkpoint(folder / CHECKPOINTS / "last.ckpt")[RECORD])


def check_data(run: Run, source: DataSource) -> None:
    """Refuse data that are not those that a run was trained on.

    An added or edited file moves runs between training, validation and test, so that the training
    may have seen a test motion.

    Raises:
        ConfigError: with what has changed since.
    """
    require_same_data(run.folder, run.data, source.name, data_identity(source))


def require_same_data(
    folder: Path, before: Mapping[str, Any], name: str, now: Mapping[str, Any]
) -> None:
    """Refuse data of another identity than a checkpoint of the folder has."""
    changes = data_changes(before, now) if before else []
    if changes:
        shown = changes[:_SHOWN]
        if len(changes) > _SHOWN:
            shown.append(f"and {len(changes) - _SHOWN} more")
        raise ConfigError(
            f"{name} has changed since {folder} was trained:\n  "
            + "\n  ".join(shown)
            + "\nBring the data back as they were, or train again"
        )


def write_config(folder: Path, config: dict[str, Any]) -> None:
    """Write the resolved configuration of a run."""
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / CONFIG, yaml.safe_dump(config, sort_keys=False, allow_unicode=True))


def read_metrics(folder: Path) -> dict[str, Any] | None:
    """Read the record of a finished training; None if it has not finished.

    Raises:
        ConfigError: if the file is damaged.
    """
    path = folder / METRICS
    if not path.is_file():
        return None
    try:
        record = json.loads(path.read_text())
        if not isinstance(record.get("validation"), dict):
            raise TypeError("it has no validation errors")
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise ConfigError(f"{path} cannot be read, it may be cut short: {error}") from error
    return record


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write a record that is whole or absent."""
    write_whole(path, json.dumps(values, indent=2))


@contextlib.contextmanager
def claimed(folder: Path, config: dict[str, Any]) -> Iterator[None]:
    """Work in a run folder, alone in it and with the configuration that it was made for.

    Raises:
        ConfigError: if another process works there, or the folder holds a training of another
            configuration; names the keys that differ.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / _LOCK, timeout=0):
            for partial in folder.rglob("*.partial"):  # of a process that was killed while writing
                partial.unlink(missing_ok=True)
            _refuse_another(folder, config)
            write_config(folder, config)
            yield
    except Timeout as error:
        raise ConfigError(f"{folder} is in use: another process trains there") from error


def _refuse_another(folder: Path, config: dict[str, Any]) -> None:
    """Refuse a folder with a readable checkpoint of another configuration."""
    for name in ("last", "best"):
        with contextlib.suppress(ConfigError):
            saved = read_checkpoint(folder / CHECKPOINTS / f"{name}.ckpt")
            break
    else:
        return
    ours, theirs = flattened(config), flattened(saved["hyper_parameters"]["config"])
    differences = [
        f"{key}={ours.get(key, 'absent')} (there {theirs.get(key, 'absent')})"
        for key in dict.fromkeys([*ours, *theirs])
        if ours.get(key, "absent") != theirs.get(key, "absent") and key != "dataset.cache"
    ]
    if differences:
        more = ["..."] if len(differences) > 5 else []
        raise ConfigError(
            f"{folder} holds a training of another configuration: "
            f"{', '.join(differences[:5] + more)}; choose another folder, or delete this one"
        )


def flattened(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested sections as dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        flat |= (
            flattened(value, f"{name}.") if isinstance(value, Mapping) and value else {name: value}
        )
    return flat
