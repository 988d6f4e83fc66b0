"""Run folders: their layout, whose they are, and how a trained model is loaded back."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from filelock import FileLock, Timeout

from pinn_dyn import __version__
from pinn_dyn.app.build import CHECKPOINTS, VALIDATION_ERROR, build_predictor
from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.keys import KEYS
from pinn_dyn.app.schema import check_value
from pinn_dyn.app.settings import flatten
from pinn_dyn.app.trust import read_foreign
from pinn_dyn.data.whole import write_whole
from pinn_dyn.ensembles import Ensemble, posterior_draws
from pinn_dyn.mechanics import Predictor
from pinn_dyn.models import Statistics
from pinn_dyn.models.output_limits import expect_output_limits
from pinn_dyn.training import COVARIANCE

CONFIG = "config.yaml"
METRICS = "metrics.json"
_LOCK = ".lock"

log = logging.getLogger(__name__)

_PLACES = ("dataset.cache",)  # where things lie does not change what is learned
# Beside the model and the data set, what decides which weights come out.
_LEARNING = ("seed", "data", "loss", "optimizer", "scheduler")
# Of a record, beside those of its validation.
_NUMBERS = ("pairs", "parameters", "steps", "training_seconds", "training_cpu_seconds")


@dataclass(frozen=True)
class Run:
    """A trained model with its resolved configuration, scales and recorded metrics.

    ``covariance`` is that of the constants that least squares fitted, ``(P, P)``; else None.
    """

    folder: Path
    config: dict[str, Any]
    model: Predictor
    statistics: Statistics
    metrics: dict[str, Any]
    covariance: torch.Tensor | None = None

    def members(self) -> Ensemble | None:
        """What intervals of predictions come from; None for a single network.

        These are the members of an ensemble, or draws of the constants that least squares fitted.

        Raises:
            ConfigError: if the covariance is none of the model.
        """
        if isinstance(self.model, Ensemble):
            return self.model
        if self.covariance is None:
            return None
        try:
            return posterior_draws(self.model, self.covariance)
        except ValueError as error:
            raise ConfigError(f"{self.folder}: {error}") from error


def write_config(folder: Path, config: dict[str, Any]) -> None:
    """Write the resolved configuration of a run."""
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / CONFIG, yaml.safe_dump(config, sort_keys=False, allow_unicode=True))


def read_config(folder: Path, trust: tuple[str, ...] = ()) -> dict[str, Any]:
    """The resolved configuration of a run, which may come from anyone: see :mod:`trust`.

    Raises:
        ConfigError: if the folder is no run folder, its configuration is damaged, or it names what
            a configuration of a run folder may not build.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise ConfigError(
            f"{folder} is not a run folder: it has no {CONFIG}. A run folder is what train.py "
            "writes, such as runs/soft_arm_1/hnn-seed0/<date>"
        )
    return read_foreign(path, trust)


def require_finished(folder: Path) -> None:
    """Refuse a run folder whose training has not ended.

    Raises:
        ConfigError: saying whether it is in progress, or was interrupted.
    """
    if (folder / METRICS).is_file() or not (folder / CONFIG).is_file():
        return
    try:
        if (folder / _LOCK).is_file():
            with FileLock(folder / _LOCK, timeout=0):
                pass
    except Timeout as error:
        raise ConfigError(
            f"{folder} holds a training in progress, expected one that has ended and written "
            f"{METRICS}: wait for it"
        ) from error
    raise ConfigError(
        f"{folder} holds a training that was interrupted, expected one that has ended and written "
        f"{METRICS}: go on with it by 'python train.py resume={folder}', or train again"
    )


def load_run(folder: Path, checkpoint: str, trust: tuple[str, ...] = ()) -> Run:
    """Load a run's model from one of its checkpoints, ``best`` or ``last``.

    Args:
        folder: the run folder.
        checkpoint: ``best`` or ``last``.
        trust: packages whose classes the run's configuration may build, besides those of this one.

    Raises:
        ConfigError: if the folder is no run folder, the checkpoint is missing or damaged, or it
            belongs to another model or data set than the configuration says; if another version
            of this program made the run, it says which.
    """
    try:
        return _load_run(folder, checkpoint, trust)
    except ConfigError as error:
        made_by = _version(folder)
        if made_by in (None, __version__):
            raise
        raise ConfigError(
            f"{error}. The run was made by pinn_dyn {made_by}, and this is {__version__}: load it "
            "with that version, or train it again"
        ) from error


def _version(folder: Path) -> str | None:
    """The version that made a run; None where there is no whole record of it."""
    try:
        record = json.loads((folder / METRICS).read_text())
        return record.get("pinn_dyn", "0.2 or before")
    except (OSError, ValueError, AttributeError, RecursionError):
        return None


def _load_run(folder: Path, checkpoint: str, trust: tuple[str, ...]) -> Run:
    config = read_config(folder, trust)
    for key, kind in (("dataset", dict), ("model", dict), ("model_name", str), ("seed", int)):
        if not isinstance(config.get(key), kind):
            raise ConfigError(
                f"{folder / CONFIG}: {key} is {config.get(key)!r}, expected what train.py writes"
            )
    check_value(f"{folder / CONFIG}: seed", config["seed"], KEYS["train"]["seed"])
    path = folder / CHECKPOINTS / f"{checkpoint}.ckpt"
    saved = read_checkpoint(path)
    parameters = saved["hyper_parameters"]
    require_same(path, parameters["config"], folder, config)
    try:
        statistics = Statistics.from_dict(parameters["statistics"])
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
    model = build_predictor(config, statistics)
    _take_weights(model, path, folder, saved["state_dict"])
    found = saved.get(COVARIANCE)
    covariance = found if isinstance(found, torch.Tensor) and found.ndim == 2 else None
    metrics = read_metrics(folder) or {}
    if metrics.get("seed", config["seed"]) != config["seed"]:
        raise ConfigError(
            f"{folder / METRICS} is of another run: its seed is {metrics['seed']}, and that of "
            f"{folder / CONFIG} is {config['seed']}: bring its own back, or train it again"
        )
    return Run(folder, config, model.eval(), statistics, metrics, covariance)


def require_same(path: Path, saved: dict[str, Any], folder: Path, config: dict[str, Any]) -> None:
    """Refuse a checkpoint whose training was not that of a run's configuration.

    Args:
        path: the checkpoint.
        saved: the configuration that it holds.
        folder: the run folder.
        config: the configuration of the run.

    Raises:
        ConfigError: with the first value that differs.
    """
    for part in _WHAT:
        here, there = (
            {k: v for k, v in one[part].items() if k != "cache"} for one in (config, saved)
        )
        if there != here:
            raise ConfigError(
                f"{path} holds weights of another {_WHAT[part]} than {folder / CONFIG} describes "
                f"({_differing(here, there)})"
            )
    here, there = (
        {
            **{key: one[key] for key in _LEARNING if key in one},
            "trainer": {k: v for k, v in dict(one.get("trainer") or {}).items() if k == "steps"},
        }
        for one in (config, saved)
    )
    if there != here:
        raise ConfigError(
            f"{path} is of another training than {folder / CONFIG} describes "
            f"({_differing(here, there)}): bring back the file that was exchanged or edited, or "
            "train again in a folder of its own"
        )


def _take_weights(
    model: Predictor, path: Path, folder: Path, state: Mapping[str, torch.Tensor]
) -> None:
    """Give a model the weights of a checkpoint.

    Raises:
        ConfigError: if they are those of another model, or not finite.
    """
    weights = {k.removeprefix("model."): x for k, x in state.items() if k.startswith("model.")}
    expect_output_limits(model, weights)
    for key, own in model.state_dict().items():
        found = weights.get(key)
        if found is not None and (found.shape != own.shape or not _alike(found, own)):
            raise ConfigError(
                f"{path} holds weights of another model than {folder / CONFIG} describes: {key} is "
                f"{tuple(found.shape)} of {found.dtype}, expected {tuple(own.shape)} of {own.dtype}"
            )
    if other := weights.keys() ^ model.state_dict().keys():
        raise ConfigError(
            f"{path} holds weights of another model than {folder / CONFIG} describes: only one of "
            f"them has {', '.join(sorted(other)[:5])}"
        )
    if broken := [key for key, value in weights.items() if not value.isfinite().all()]:
        raise ConfigError(
            f"{path} holds weights that are NaN or infinite ({broken[0]}): its training diverged, "
            "take another checkpoint or train again with a lower optimizer.lr"
        )
    model.load_state_dict(weights)


def _alike(found: torch.Tensor, own: torch.Tensor) -> bool:
    """Whether both are plain numbers of one kind, in any precision."""
    plain = found.layout == torch.strided and found.device.type == "cpu" and not found.is_quantized
    return plain and found.dtype.is_floating_point == own.dtype.is_floating_point


def read_metrics(folder: Path) -> dict[str, Any] | None:
    """What a finished training recorded; None if it has not finished.

    Raises:
        ConfigError: if the record is damaged, or none of train.py.
    """
    path = folder / METRICS
    if not path.is_file():
        return None
    try:
        record = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path} cannot be read, it may be cut short: {error}") from error
    if isinstance(record, dict) and isinstance(validation := record.get("validation", {}), dict):
        numbers = [*validation.values(), *(record[key] for key in _NUMBERS if key in record)]
        if all(type(number) in (int, float) for number in numbers):
            return record
    raise ConfigError(f"{path} holds no record that train.py wrote")


_WHAT = {"model": "model", "dataset": "data set"}


def _differing(here: dict[str, Any], there: dict[str, Any]) -> str:
    """The first value in which two configurations differ."""
    one, other = flatten(here), flatten(there)
    key = next((key for key in [*one, *other] if one.get(key) != other.get(key)), None)
    if key is None:  # flatten keeps neither the modules of classes nor empty sections
        return "in the module of a class, in an empty section, or in a value that is not a number"
    return f"{key} is {one.get(key, 'absent')}, the checkpoint has {other.get(key, 'absent')}"


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What a checkpoint holds: tensors and plain values, no code.

    Raises:
        ConfigError: if it is missing, damaged, or no checkpoint of this program.
    """
    if not path.is_file():
        found = sorted(p.stem for p in path.parent.glob("*.ckpt"))
        raise ConfigError(
            f"{path} does not exist; {path.parent} has {', '.join(found) or 'no checkpoint'}"
        )
    try:
        with zipfile.ZipFile(path) as archive:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
                raise zipfile.BadZipFile("it is compressed, which no checkpoint is")
            if damaged := archive.testzip():  # torch.load does not compare the checksums
                raise zipfile.BadZipFile(f"{damaged} has another checksum")
        saved = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged archive or pickle raises nearly anything
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ConfigError(f"{path} cannot be read, it may be cut short: {said}") from error
    parameters = saved.get("hyper_parameters") if isinstance(saved, dict) else None
    if (
        not isinstance(parameters, dict)
        or not isinstance(saved.get("state_dict"), dict)
        or not isinstance(parameters.get("statistics"), dict)
        or not isinstance(parameters.get("config"), dict)
        or not all(isinstance(parameters["config"].get(key), dict) for key in _WHAT)
        or not all(isinstance(key, str) for key in saved["state_dict"])
        or not all(isinstance(value, torch.Tensor) for value in saved["state_dict"].values())
    ):
        raise ConfigError(f"{path} is no checkpoint that train.py wrote")
    return saved


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write a record that is whole or absent."""
    write_whole(path, json.dumps(values, indent=2))


@contextlib.contextmanager
def claimed(folder: Path, config: dict[str, Any]) -> Iterator[None]:
    """Work in a run folder, alone in it and with the configuration that it was made for.

    Raises:
        ConfigError: if another process works there, or the folder was made for another
            configuration; it names the keys that differ.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / _LOCK, timeout=0):
            for left in folder.rglob("*.partial"):  # of one that was killed while it wrote
                left.unlink(missing_ok=True)
            # A training that failed before its first checkpoint leaves nothing to be mixed up.
            if (folder / METRICS).is_file() or (folder / CHECKPOINTS / "last.ckpt").is_file():
                _refuse_another(folder, config)
            else:
                write_config(folder, config)
            yield
    except Timeout as error:
        raise ConfigError(f"{folder} is in use: another process trains there") from error


def _refuse_another(folder: Path, config: dict[str, Any]) -> None:
    here, there = flatten(config), flatten(read_config(folder))
    differing = [
        f"{key}={here.get(key, 'absent')} (there {there.get(key, 'absent')})"
        for key in dict.fromkeys([*here, *there])
        if here.get(key) != there.get(key) and key not in _PLACES
    ]
    if differing:
        shown = differing[:5] + (["..."] if len(differing) > 5 else [])
        raise ConfigError(
            f"{folder} holds a training of another configuration: {', '.join(shown)}; choose "
            "another folder, or delete this one"
        )


def recorded_error(folder: Path) -> float | None:
    """The validation error that a finished training recorded; None if it has not finished."""
    record = read_metrics(folder)
    return None if record is None else record.get("validation", {}).get(VALIDATION_ERROR, math.nan)
