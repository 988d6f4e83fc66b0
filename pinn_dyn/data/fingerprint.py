"""What data depend on, as plain JSON: settings, constants and the code of a user's own classes."""

from __future__ import annotations

import hashlib
import json
import math
import sys
import types
from collections.abc import Iterator, Mapping, Sequence, Set
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from pinn_dyn.data.cache import cache_key

# Larger arrays are told apart by a hash.
_SHOWN = 64
_PLAIN_MODULE = frozenset(vars(torch.nn.Module()))


def describe(value: object) -> Any:
    """A value as JSON: lists, dictionaries and plain values that tell it from any other.

    An object is its class and attributes; one with a method ``describe()`` is what that returns.
    A class is its name and, beyond Python's own and foreign packages, a hash of its methods and of
    all functions, classes and constants of its package that these refer to: an edited equation is
    another description, an edited comment or docstring is not. Of this package the room (systems,
    data) counts as a package, and its bases in mechanics are known by name.

    Raises:
        TypeError: on an object that says nothing about itself; says what to add.
    """
    return _describe(value, ())


def _describe(value: Any, above: tuple[int, ...]) -> Any:
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if id(value) in above:
        return "itself"
    inside = (*above, id(value))
    if isinstance(value, torch.Tensor):
        return _array(value.detach().cpu().numpy())
    if isinstance(value, (np.ndarray, np.generic)):
        return _array(np.asarray(value))
    if isinstance(value, Mapping):
        return {str(key): _describe(item, inside) for key, item in value.items()}
    if isinstance(value, Set):
        return sorted((_describe(item, inside) for item in value), key=json.dumps)
    if isinstance(value, (Sequence, range)) and not isinstance(value, (bytes, bytearray)):
        return [_describe(item, inside) for item in value]
    if isinstance(value, (bytes, Path, torch.dtype, torch.device, complex)):
        return str(value)
    if isinstance(value, type):
        return _class(value)
    if isinstance(value, partial):
        return _describe([value.func, value.args, value.keywords], inside)
    if isinstance(value, types.MethodType):
        return _describe([value.__func__, value.__self__], inside)
    if isinstance(value, types.FunctionType):
        return f"{value.__qualname__} {cache_key(_Code(_package(value)).refer(value))}"
    if callable(own := getattr(value, "describe", None)):
        return {"class": _class(type(value)), **cast("Mapping[str, object]", own())}
    return {"class": _class(type(value)), **_describe(_attributes(value), inside)}


def _attributes(value: object) -> dict[str, object]:
    if isinstance(value, torch.nn.Module):
        parts = (value._parameters, value._buffers, value._modules)
        own = {key: item for key, item in vars(value).items() if key not in _PLAIN_MODULE}
        return own | {key: item for part in parts for key, item in part.items()}
    slots = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())]
    if hasattr(value, "__dict__"):
        return dict(vars(value))
    if slots:
        return {name: getattr(value, name) for name in slots if hasattr(value, name)}
    if "__repr__" in vars(type(value)) and " at 0x" not in repr(value):
        return {"value": repr(value)}
    raise TypeError(
        f"{type(value).__module__}.{type(value).__qualname__} does not say what it depends on, so "
        "data made with it cannot be kept: give the class a method describe() that returns a dict "
        "of its settings"
    )


def _array(value: np.ndarray) -> object:
    if value.dtype == object:
        return [_describe(item, ()) for item in value.tolist()]
    if value.size <= _SHOWN:
        return _describe(value.tolist(), ())
    content = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()[:16]
    return {"dtype": str(value.dtype), "shape": list(value.shape), "sha256": content}


def _class(kind: type) -> str:
    """Its name, and the hash of its code where it has some of its own."""
    code = _Code(_package(kind)).members(kind)
    return f"{kind.__qualname__} {cache_key(code)}" if code else kind.__qualname__


def _package(item: Any) -> str:
    """The package that a class or function belongs to; of this package, the room."""
    first, *rest = (getattr(item, "__module__", None) or "").split(".")
    return ".".join([first, *rest[:1]]) if first == "pinn_dyn" else first


class _Code:
    """The code of a package that its classes and functions consist of, each of them once."""

    def __init__(self, package: str, seen: set[int] | None = None):
        self._package = package
        self._seen = set[int]() if seen is None else seen

    def members(self, kind: type) -> dict[str, object]:
        """The methods and constants of a class and of its bases."""
        found: dict[str, object] = {}
        for base in kind.__mro__:
            if (package := _package(base)) not in _KNOWN_BY_NAME:
                code = _Code(package, self._seen)
                for name, member in vars(base).items():
                    dunder = name.startswith("__") and not isinstance(member, types.FunctionType)
                    if not (dunder or isinstance(member, _DESCRIPTORS)):
                        found[f"{base.__qualname__}.{name}"] = code.refer(member)
        return found

    def function(self, function: types.FunctionType) -> object:
        """Its instructions and constants, and what its names and its closure stand for."""
        if not self._new(function):
            return function.__qualname__
        cells = [cell.cell_contents for cell in function.__closure__ or () if _filled(cell)]
        around = [*cells, function.__defaults__, function.__kwdefaults__]
        code = self._instructions(function.__code__, function.__globals__)
        return [*code, *map(self.refer, around)]

    def refer(self, item: Any) -> object:
        """What a name in the code stands for."""
        item = getattr(item, "__func__", item)  # static and class methods
        if isinstance(item, property):
            return [self.refer(part) for part in (item.fget, item.fset)]
        if isinstance(item, _CONSTANTS):
            return describe(item)
        if isinstance(item, (Mapping, list, tuple)) and self._new(item):
            values = item.values() if isinstance(item, Mapping) else item
            keys = map(str, item) if isinstance(item, Mapping) else ()
            return [*keys, *map(self.refer, values)]
        if isinstance(item, (type, types.FunctionType)) and _package(item) == self._package:
            if isinstance(item, types.FunctionType):
                return self.function(item)
            return self.members(item) if self._new(item) else item.__qualname__
        if hasattr(item, "__wrapped__"):  # functools.cache and the like
            return self.refer(item.__wrapped__)
        return getattr(item, "__qualname__", type(item).__qualname__)

    def _instructions(self, code: types.CodeType, names: Mapping[str, object]) -> list[object]:
        first, *others = code.co_consts or (None,)  # the first is the docstring
        constants = [
            self._instructions(item, names) if isinstance(item, types.CodeType) else describe(item)
            for item in (others if isinstance(first, str) else [first, *others])
            if item is not Ellipsis
        ]
        used = {name: self.refer(item) for name, item in self._globals(code, names)}
        return [code.co_code.hex(), list(code.co_names), constants, used]

    def _globals(
        self, code: types.CodeType, names: Mapping[str, object]
    ) -> Iterator[tuple[str, object]]:
        for name in code.co_names:
            item = names.get(name)
            if not isinstance(item, types.ModuleType):
                yield from [(name, item)] if name in names else []
            elif item.__name__.split(".")[0] == self._package.split(".")[0]:
                yield from ((n, vars(item)[n]) for n in code.co_names if n in vars(item))

    def _new(self, item: object) -> bool:
        known = id(item) in self._seen
        self._seen.add(id(item))
        return not known


_CONSTANTS = (
    *(bool, int, float, complex, str, bytes, type(None), set, frozenset, range, Path),
    *(np.ndarray, np.generic, torch.Tensor),
)
_DESCRIPTORS = (types.GetSetDescriptorType, types.MemberDescriptorType)
_KNOWN_BY_NAME = sys.stdlib_module_names | {"pinn_dyn.mechanics", "torch", "numpy", "scipy"}


def _filled(cell: types.CellType) -> bool:
    try:
        cell.cell_contents  # noqa: B018
    except ValueError:  # not assigned yet
        return False
    return True
