"""Objects that a configuration describes, part by part."""

from __future__ import annotations

import contextlib
import inspect
import os
import pkgutil
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from pinn_dyn.data import DataSource
from pinn_dyn.data.cache import plain
from pinn_dyn.mechanics import Predictor
from pinn_dyn.run.configuration.validation import ConfigError, check_value

ModelBuilder = Callable[..., Predictor]
"""Builder of a model, called with ``statistics=``."""


def build_source(config: dict[str, Any]) -> DataSource:
    """Build the data source of ``config["dataset"]``; a simulated one gets the cache folder."""
    part = config["dataset"]
    if "cache" in inspect.signature(pkgutil.resolve_name(part["_target_"])).parameters:
        part = {"cache": os.environ.get("PINN_DYN_CACHE", "~/.cache/pinn_dyn"), **part}
    return build_part("dataset", part)


def model_builder(config: dict[str, Any]) -> ModelBuilder:
    """Return the builder of ``config["model"]``."""
    if config["model"] is None:
        raise ConfigError("the model was built in Python: use pinn_dyn.load(folder, model=builder)")
    return build_part("model", config["model"], partial_=True)


@contextlib.contextmanager
def naming(part: str) -> Iterator[None]:
    """Name the part of the configuration that an error is about."""
    try:
        yield
    except Exception as error:
        # The class of Lightning is compared by name, since the import takes seconds.
        of_lightning = type(error).__name__ == "MisconfigurationException"
        if isinstance(error, ConfigError) or not (
            of_lightning or isinstance(error, TypeError | ValueError)
        ):
            raise
        raise ConfigError(f"{part}: {error}") from error


def build_part(
    name: str, config: dict[str, Any], /, *arguments: Any, partial_: bool = False, **extra: Any
) -> Any:
    """Build the object that a part of the configuration describes; ``name`` is its path.

    The program adds ``arguments`` and ``extra``, or takes a factory with ``partial_``. A
    ConfigError names the argument that does not fit, or has the message of the constructor.
    """
    check_value(name, config)
    try:
        maker = built({**config, "_partial_": True})
        return maker if partial_ else maker(*arguments, **extra)
    except Exception as error:  # constructors may raise anything
        reason = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
        raise ConfigError(f"{name}: {reason}") from error


def built(part: Any) -> Any:
    """Build the objects that a part of a configuration describes, without checks."""
    if isinstance(part, list):
        return [built(item) for item in part]
    if not isinstance(part, dict):
        return part
    values = {k: built(x) for k, x in part.items() if k not in ("_target_", "_partial_")}
    if "_target_" not in part:
        return values
    maker = partial(pkgutil.resolve_name(part["_target_"]), **values)
    return maker if part.get("_partial_") else maker()


def described(value: Any) -> Any:
    """Return the configuration that builds a value: ``_target_`` and arguments.

    A class or a ``functools.partial`` gets ``_partial_: true``. An object is described by the
    attributes that have the names of its constructor's arguments.
    """
    return plain(value, _described_object)


def _described_object(value: Any) -> Any:
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, partial):
        if value.args:
            raise TypeError(f"{value} has positional arguments, expected arguments by name")
        return {**described(value.func), **described(value.keywords)}
    if isinstance(value, type) or inspect.isfunction(value):
        return {"_target_": _path(value), "_partial_": True}
    names = inspect.signature(type(value)).parameters
    arguments = {name: described(getattr(value, name)) for name in names}
    return {"_target_": _path(type(value)), **arguments}


def _path(item: Any) -> str:
    """Return the shortest dotted name by which a class or function can be imported."""
    name, parts = str(item.__qualname__), item.__module__.split(".")
    for count in range(min(2, len(parts)), len(parts) + 1):
        module = ".".join(parts[:count])
        if getattr(sys.modules.get(module), name, None) is item:
            return f"{module}.{name}"
    raise TypeError(f"{item} cannot be imported by its name")
