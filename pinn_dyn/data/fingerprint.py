"""Description of a simulation as plain JSON: the key of its recordings in the cache."""

from __future__ import annotations

import dataclasses
import hashlib
import marshal
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

_MODULE_ATTRIBUTES = frozenset(vars(torch.nn.Module()))
# Packages whose classes are identified by their names.
_PACKAGES = sys.stdlib_module_names | {"pinn_dyn", "torch", "numpy", "scipy"}


def describe(value: object) -> Any:
    """Describe a value as JSON: an object by its class and its ``describe()`` or its attributes.

    A class of this package is identified by its name, so an edited docstring leaves recordings
    valid. The description of a class of your own includes a hash of the file that defines it.

    Raises:
        TypeError: on an object that cannot be pickled; give its class a method ``describe()``.
    """
    return plain(value, _described_object)


def plain(value: object, describe_object: Callable[[Any], Any]) -> Any:
    """Convert tensors, mappings and sequences to JSON, and other objects by a function."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (torch.Tensor, np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(item, describe_object) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [plain(item, describe_object) for item in value]
    return describe_object(value)


def _described_object(value: Any) -> Any:
    if isinstance(value, (type, types.FunctionType)):
        return _definition(value)
    if hasattr(value, "describe"):
        settings = value.describe()
    elif isinstance(value, torch.nn.Module):
        settings = {k: item for k, item in vars(value).items() if k not in _MODULE_ATTRIBUTES}
        settings |= {**value._parameters, **value._buffers, **value._modules}
    elif dataclasses.is_dataclass(value):
        settings = {item.name: getattr(value, item.name) for item in dataclasses.fields(value)}
    else:
        return describe(value.__reduce_ex__(2))
    return {"class": _definition(type(value)), **describe(settings)}


def _definition(item: type | types.FunctionType) -> str:
    """Return the name of a class or function, with a hash of its source if it is the user's."""
    kinds = item.__mro__ if isinstance(item, type) else [item]
    sources = {_source(kind) for kind in kinds if kind.__module__.split(".")[0] not in _PACKAGES}
    if not sources:
        return item.__qualname__
    return f"{item.__qualname__} {hashlib.sha256(b''.join(sorted(sources))).hexdigest()[:16]}"


def _source(item: type | types.FunctionType) -> bytes:
    path = getattr(sys.modules.get(item.__module__), "__file__", None)
    if path is not None and item.__module__ != "__main__":
        return Path(path).read_bytes()
    members = [item, *vars(item).values()]
    return b"".join(marshal.dumps(x.__code__) for x in members if hasattr(x, "__code__"))
