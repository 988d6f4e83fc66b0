"""Trust in configurations of run folders, which may come from anyone: what they may build."""

from __future__ import annotations

import ast
import pkgutil
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from pinn_dyn.run.configuration.signatures import definition
from pinn_dyn.run.configuration.validation import ConfigError, places
from pinn_dyn.systems.urdf_file import is_mjcf

_PACKAGES = (
    *("control", "data", "data.logs", "evaluation", "mechanics", "models", "systems"),
    *("training", "training.losses"),
)
"""Packages of pinn_dyn whose public classes may be built: none writes files or loads code."""

_CALLBACKS = "EarlyStopping EMAWeightAveraging GradientAccumulationScheduler LearningRateMonitor "
_CALLBACKS += "ModelCheckpoint StochasticWeightAveraging Timer WeightAveraging"
_SCHEDULERS = "ConstantLR CosineAnnealingLR CosineAnnealingWarmRestarts CyclicLR ExponentialLR "
_SCHEDULERS += "LinearLR MultiStepLR OneCycleLR PolynomialLR StepLR"
_CLASSES = {
    "pinn_dyn.training": "one_cycle",
    "pytorch_optimizer": "SOAP",
    "lightning": "Trainer",
    "lightning.pytorch": "Trainer",
    "lightning.pytorch.callbacks": _CALLBACKS,
    "lightning.pytorch.loggers": "CSVLogger TensorBoardLogger",
    "torch.optim": "Adadelta Adagrad Adam AdamW Adamax NAdam RAdam RMSprop SGD",
    "torch.optim.lr_scheduler": _SCHEDULERS,
}
_ALLOWED = {f"{package}.{name}" for package, names in _CLASSES.items() for name in names.split()}

_DESTINATIONS = (
    *("artifact_location", "cache", "default_root_dir", "dirpath", "log_dir", "plugins", "prefix"),
    *("profiler", "root_dir", "save_dir", "sub_dir", "tracking_uri"),
)
"""Arguments that say where something is written or sent to."""


def packages(trust: str | Sequence[str] | None) -> tuple[str, ...]:
    """Return the packages that the user trusts."""
    return tuple([trust] if isinstance(trust, str) else trust or ())


def require_trusted(config: dict[str, Any], source: str, trust: tuple[str, ...] = ()) -> None:
    """Refuse a configuration of a file that names code other than the allowed classes.

    Classes of the packages ``trust`` are allowed too. A ConfigError names the key.
    """
    for path, value in places(config):
        key = f"{source}: {path or 'the configuration'}"
        if isinstance(value, dict):
            _require_trusted_mapping(key, value, trust)
        elif isinstance(value, str) and "${" in value:
            raise ConfigError(f"{key} is the expression {value!r}, expected a value")
    check_name(f"{source}: model_name", config.get("model_name", "model"))
    for name in (config.get("dataset") or {}).get("configurations") or ():
        check_name(f"{source}: dataset.configurations", name)


def _require_trusted_mapping(path: str, part: dict[Any, Any], trust: tuple[str, ...]) -> None:
    for key in part:
        special = not isinstance(key, str) or key.startswith("_") or "${" in key
        if special and key not in ("_target_", "_partial_"):
            raise ConfigError(f"{path} has the key {key!r}, which no configuration of a run has")
    if "_target_" not in part or is_trusted(target := part["_target_"], trust):
        return
    if not may_build(target, ()):
        raise ConfigError(
            f"{path}._target_ is {target!r}. A configuration from a run folder may name the "
            "classes of pinn_dyn and a few others only. If this is your own class and you trust "
            f"the author of the folder, add trust={str(target).split('.')[0]} (SECURITY.md)"
        )
    if isinstance(urdf := part.get("urdf"), str) and is_mjcf(urdf):
        raise ConfigError(
            f"{path}.urdf is an MJCF, which MuJoCo would have to read: a run folder holds the text "
            f"of a URDF only; if you trust the author of the folder, add trust={target}"
        )
    for key in _DESTINATIONS:
        if part.get(key) is not None:
            raise ConfigError(
                f"{path}.{key} is {part[key]!r}: a configuration from a run folder does not choose "
                f"where something is written, unless you add trust={target}"
            )
    for key in ("name", "filename", "filename_suffix", "version"):
        if part.get(key) is not None:
            check_name(f"{path}.{key}", part[key])


def may_build(target: Any, trust: tuple[str, ...]) -> bool:
    """Return whether a configuration from a run folder may name a class."""
    package, _, name = str(target).rpartition(".")
    if package.removeprefix("pinn_dyn.") in _PACKAGES and package.startswith("pinn_dyn."):
        # From the source, since some of the classes import Lightning.
        module, node = definition(target) if name in import_module(package).__all__ else ("", None)
        if isinstance(node, ast.ClassDef) and module.startswith("pinn_dyn."):
            return True
    return str(target) in _ALLOWED or is_trusted(target, trust)


def is_trusted(target: Any, trust: tuple[str, ...]) -> bool:
    """Return whether a class is defined in a trusted package, not only imported there."""
    for package in trust:
        if target == package or str(target).startswith(f"{package}."):
            home = getattr(pkgutil.resolve_name(target), "__module__", None) or ""
            return target == package or f"{home}.".startswith(f"{package}.")
    return False


def check_name(path: str, name: Any) -> None:
    """Refuse a name of a file that would lead out of its folder."""
    if not isinstance(name, str) or set(name) & set("/\\\0\n") or name in ("", ".", ".."):
        raise ConfigError(f"{path} is {name!r}, expected a name of a file, without separators")
