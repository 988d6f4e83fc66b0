"""Configuration of objects that were made in Python, as a YAML file would describe them."""

from __future__ import annotations

import inspect
import sys
from functools import partial
from pathlib import Path
from typing import Any

from pinn_dyn.data.fingerprint import plain


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
