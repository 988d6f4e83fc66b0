"""Description of a simulation as plain JSON: the key of its recordings in the cache."""

from __future__ import annotations

import hashlib
import json
import marshal
import math
import sys
import types
from collections.abc import Mapping, Sequence, Set
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

# Longer arrays are represented by a hash.
_LONGEST_ARRAY = 64
_MODULE_ATTRIBUTES = frozenset(vars(torch.nn.Module()))
# Packages whose classes are identified by their names.
_PACKAGES = sys.stdlib_module_names | {"pinn_dyn", "torch", "numpy", "scipy"}


def describe(value: object) -> Any:
    """Describe a value as JSON: plain values, lists and dictionaries.

    An object is described by its class and its attributes; an object with a method ``describe()``
    by what that returns. A class of this package is identified by its name, so that an edited
    docstring leaves recordings valid: raise the data version of a source when its data change. The
    description of a class of your own includes a hash of the file that defines it.

    Raises:
        TypeError: on an object without attributes; says what to add.
    """
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, torch.Tensor):
        return _array(value.detach().cpu().numpy())
    if isinstance(value, (np.ndarray, np.generic)):
        return _array(np.asarray(value))
    if isinstance(value, Mapping):
        return {str(key): describe(item) for key, item in value.items()}
    if isinstance(value, Set):
        return sorted(map(describe, value), key=json.dumps)
    if isinstance(value, (bytes, Path, torch.dtype, torch.device, complex)):
        return str(value)
    if isinstance(value, (Sequence, range)):
        return [describe(item) for item in value]
    if isinstance(value, (type, types.FunctionType)):
        return _definition(value)
    if isinstance(value, partial):
        return describe([value.func, value.args, value.keywords])
    if isinstance(value, types.MethodType):
        return describe([value.__func__, value.__self__])
    settings = getattr(value, "describe", None)
    if callable(settings):
        return {"class": _definition(type(value)), **cast("Mapping[str, object]", settings())}
    return {"class": _definition(type(value)), **describe(_attributes(value))}


def _attributes(value: object) -> dict[str, object]:
    if isinstance(value, torch.nn.Module):
        plain = {k: item for k, item in vars(value).items() if k not in _MODULE_ATTRIBUTES}
        return {**plain, **value._parameters, **value._buffers, **value._modules}
    if hasattr(value, "__dict__"):
        return dict(vars(value))
    slots = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())]
    if not slots:
        kind = type(value)
        raise TypeError(
            f"{kind.__module__}.{kind.__qualname__} has no attributes that describe it, so data "
            "made with it cannot be cached: give the class a method describe() that returns a "
            "dict of its settings"
        )
    return {name: getattr(value, name) for name in slots if hasattr(value, name)}


def _array(value: np.ndarray) -> object:
    if value.size <= _LONGEST_ARRAY or value.dtype == object:
        return describe(value.tolist())
    content = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()[:16]
    return {"dtype": str(value.dtype), "shape": list(value.shape), "sha256": content}


def _definition(item: type | types.FunctionType) -> str:
    """Return the name of a class or function, with a hash of its source if it is the user's."""
    kinds = item.__mro__ if isinstance(item, type) else [item]
    sources = {_source(kind) for kind in kinds if kind.__module__.split(".")[0] not in _PACKAGES}
    if not sources:
        return item.__qualname__
    return f"{item.__qualname__} {hashlib.sha256(b''.join(sorted(sources))).hexdigest()[:16]}"


def _source(item: type | types.FunctionType) -> bytes:
    """Return the file that defines a class or function; in a session, its compiled methods."""
    path = getattr(sys.modules.get(item.__module__), "__file__", None)
    if path is not None and item.__module__ != "__main__":
        return Path(path).read_bytes()
    members = [item] if isinstance(item, types.FunctionType) else vars(item).values()
    functions = [member for member in members if isinstance(member, types.FunctionType)]
    return b"".join(marshal.dumps(function.__code__) for function in functions)
