"""Configurations of run folders, which may come from anyone: what they may build.

A ``_target_`` names code that is called with the keys beside it: ``os.system`` deletes files as
readily as ``pinn_dyn.models.LagrangianNetwork`` builds a network. So a configuration that is read
from a run folder is looked through before anything is built, at every depth: it may name the
classes below, and those of a package that the user trusts by ``trust=my_package``.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import yaml

from pinn_dyn.app.keys import places
from pinn_dyn.app.schema import ConfigError, find

# By libyaml where it is there: in a tenth of the time.
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

_ROOMS = (
    "control",
    "data",
    "data.logs",
    "evaluation",
    "mechanics",
    "models",
    "systems",
    "training",
)
"""Rooms of this package whose public classes may be built: none writes files or loads code."""

_CALLBACKS = (
    "EarlyStopping",
    "EMAWeightAveraging",
    "GradientAccumulationScheduler",
    "LearningRateMonitor",
    "ModelCheckpoint",
    "StochasticWeightAveraging",
    "Timer",
    "WeightAveraging",
)
_LOGGERS = ("CSVLogger", "MLFlowLogger", "TensorBoardLogger")
_OPTIMIZERS = ("Adadelta", "Adagrad", "Adam", "AdamW", "Adamax", "NAdam", "RAdam", "RMSprop", "SGD")
_SCHEDULERS = (
    "ConstantLR",
    "CosineAnnealingLR",
    "CosineAnnealingWarmRestarts",
    "CyclicLR",
    "ExponentialLR",
    "LinearLR",
    "MultiStepLR",
    "OneCycleLR",
    "PolynomialLR",
    "StepLR",
)
ALLOWED = frozenset(
    [
        "pinn_dyn.training.one_cycle",
        "pytorch_optimizer.SOAP",
        "lightning.Trainer",
        "lightning.pytorch.Trainer",
        *(f"lightning.pytorch.callbacks.{name}" for name in _CALLBACKS),
        *(f"lightning.pytorch.loggers.{name}" for name in _LOGGERS),
        *(f"torch.optim.{name}" for name in _OPTIMIZERS),
        *(f"torch.optim.lr_scheduler.{name}" for name in _SCHEDULERS),
    ]
)

# Arguments that say where something is written or sent to, with the values that our YAMLs have.
_PLACES: dict[str, tuple[Any, ...]] = {
    "cache": (),
    "artifact_location": ("runs/mlflow/artifacts", None),
    "default_root_dir": (),
    "dirpath": (),
    "log_dir": (),
    "plugins": (),
    "prefix": (),
    "profiler": (None,),
    "root_dir": (),
    "save_dir": (),
    "sub_dir": (),
    "tracking_uri": ("sqlite:///runs/mlflow/mlflow.db",),
}

_LONGEST_NAME = 100
MOST_BYTES = 1_000_000
MOST_DEPTH = 30
MOST_NODES = 50_000
"""A configuration of this program has some hundred values, 10 kB."""


def packages(trust: str | list[str] | None) -> tuple[str, ...]:
    """The packages that the user trusts."""
    return tuple([trust] if isinstance(trust, str) else trust or ())


def read_foreign(path: Path, trust: tuple[str, ...] = ()) -> dict[str, Any]:
    """The configuration in a file, if all that it names may be built.

    What says where a cache is written is left out.

    Raises:
        ConfigError: if it cannot be read, is too large, or names what may not be built.
    """
    config = read_yaml(path)
    dataset = config.get("dataset")
    if isinstance(dataset, dict):
        dataset.pop("cache", None)
    for where, value in places(config):
        if isinstance(value, dict):
            _check_mapping(path, where, value, trust)
        elif isinstance(value, str) and "${" in value:
            raise ConfigError(
                f"{where} is {value[:80]!r}, an expression: the configuration in a run folder has "
                "values only"
            )
    if isinstance(dataset, dict):
        check_name(f"{path}: dataset.name", dataset.get("name"))
        for name in dataset.get("configurations") or ():
            check_name(f"{path}: dataset.configurations", name)
    if "model_name" in config:
        check_name(f"{path}: model_name", config["model_name"])
    return config


def read_yaml(path: Path) -> dict[str, Any]:
    """A mapping from a YAML file of bounded size, also after its aliases are written out.

    Raises:
        ConfigError: naming the file, if it cannot be read.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ConfigError(
                f"{path} has {path.stat().st_size} bytes, expected a configuration of at most "
                f"{MOST_BYTES}"
            )
        text = path.read_text(encoding="utf-8")
        _check_depth(path, text)
        values = yaml.load(text, _Loader)
        count = _size(values, {})
    except (OSError, ValueError, yaml.YAMLError, RecursionError) as error:
        if isinstance(error, ConfigError):
            raise
        said = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(f"{path} cannot be read, it may be damaged: {said}") from error
    if count > MOST_NODES:
        raise ConfigError(
            f"{path} has more than {MOST_NODES} values once its aliases are written out, expected "
            "a configuration that train.py wrote"
        )
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise ConfigError(f"{path} holds no configuration: expected a mapping of names to values")
    return values


def _check_depth(path: Path, text: str) -> None:
    """Refuse mappings in mappings in mappings without end, which take the parser for ever."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > MOST_DEPTH:
            raise ConfigError(
                f"{path} has values more than {MOST_DEPTH} levels deep, expected a configuration "
                "that train.py wrote"
            )


def _size(value: Any, known: dict[int, int]) -> int:
    """Values in nested lists and mappings; one that stands in several places counts each time."""
    if not isinstance(value, (dict, list)):
        return 1
    if id(value) not in known:
        known[id(value)] = MOST_NODES + 1  # of one that holds itself
        items = value.values() if isinstance(value, dict) else value
        known[id(value)] = 1 + sum(_size(item, known) for item in items)
    return known[id(value)]


def _check_mapping(path: Path, where: str, part: dict[Any, Any], trust: tuple[str, ...]) -> None:
    place = f"{path}: {where or 'the configuration'}"
    for key in part:
        if not isinstance(key, str) or (key[:1] == "_" and key not in ("_target_", "_partial_")):
            raise ConfigError(f"{place} has the key {key!r}, which no configuration of a run has")
        if "${" in key:
            raise ConfigError(f"{place} has the key {key[:80]!r}, an expression")
    if not isinstance(part.get("_partial_", True), bool):
        raise ConfigError(f"{place}: _partial_ is {part['_partial_']!r}, expected true or false")
    if "_target_" not in part:
        return
    if not may_build(part["_target_"], trust):
        raise ConfigError(
            f"{place}._target_ is {str(part['_target_'])[:80]!r}. What a configuration names is "
            "run, so one from a run folder may name the classes of pinn_dyn and a few others only. "
            "If this is a class of your own and you trust whoever wrote the folder, add "
            f"trust={str(part['_target_']).split('.')[0][:40]} to the command (SECURITY.md)"
        )
    for key in _PLACES.keys() & part.keys():
        if part[key] not in _PLACES[key] and not _trusted(part["_target_"], trust):
            raise ConfigError(
                f"{place}.{key} is {str(part[key])[:80]!r}: a configuration from a run folder does "
                f"not choose where something is written. If you trust it, add "
                f"trust={part['_target_']} to the command (SECURITY.md)"
            )


def may_build(target: Any, trust: tuple[str, ...]) -> bool:
    """Whether a configuration from a run folder may name this."""
    if not isinstance(target, str):
        return False
    if target in ALLOWED:
        return True
    package, _, name = target.rpartition(".")
    if package.removeprefix("pinn_dyn.") in _ROOMS and package.startswith("pinn_dyn."):
        room = importlib.import_module(package)
        found = getattr(room, name, None) if name in room.__all__ else None
        return isinstance(found, type) and found.__module__.startswith("pinn_dyn.")
    return _trusted(target, trust)


def _trusted(target: str, trust: tuple[str, ...]) -> bool:
    """Whether a name is in a trusted package, and what it names is defined there."""
    for package in trust:
        if target == package or target.startswith(f"{package}."):
            # Not a module's way out, as my_package.os.system.
            home = getattr(find(target), "__module__", None) or ""
            return home == package or f"{home}.".startswith(f"{package}.") or target == package
    return False


def check_name(where: str, name: Any) -> None:
    """Refuse what would lead out of a folder: files are named by it.

    Raises:
        ConfigError: saying where the name stands.
    """
    unusable = not isinstance(name, str) or len(name) > _LONGEST_NAME or set(name) & set("/\\\0\n")
    if unusable or name in ("", ".", ".."):
        raise ConfigError(
            f"{where} is {str(name)[:80]!r}, expected a name without separators of at most "
            f"{_LONGEST_NAME} letters, as files are named by it"
        )
