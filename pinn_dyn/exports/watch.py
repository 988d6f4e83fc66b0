"""Detect changes of the numbers and attributes that functions of a model read."""

from __future__ import annotations

import functools
import hashlib
import sys
import types
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from operator import is_, itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

_LIBRARIES = sys.stdlib_module_names | {"pinn_dyn", "torch", "numpy", "scipy", "builtins"}
"""Packages whose functions and classes do not change."""
_PLAIN = (type(None), bool, int, float, complex, str, bytes)
_MODULE = frozenset(vars(nn.Module())) - {"_parameters", "_buffers", "_modules"}
_MEMBERS = {
    property: ("fget",),
    functools.cached_property: ("func",),
    partial: ("func", "args", "keywords"),
    types.MethodType: ("__self__", "__func__"),
    **dict.fromkeys((staticmethod, classmethod), ("__func__",)),
}
_CLASS = {"__dict__", "__weakref__", "__doc__", "__module__", "_abc_impl", "__annotations__"}


class Watch:
    """Record of all values that functions of some objects read.

    The record follows attributes, containers and submodules. For classes and functions of the user,
    it includes their code, default values, closures and global names. Classes of libraries are
    assumed not to change.

    Args:
        roots: models, other objects, classes or functions.

    Attributes:
        tensors: the tensors, in the order of the search.
    """

    def __init__(self, *roots: Any):
        self.tensors: list[Tensor] = []
        self._arrays: list[tuple[Tensor | None, int, np.ndarray, bytes]] = []
        self._parts: list[tuple[Any, int, Callable[[Any], Iterable[Any]], list[Any]]] = []
        self._words: list[Any] = []
        self._seen: dict[int, tuple[int, Any]] = {}
        for root in roots:
            self._visit(root)
        self._seen.clear()

    def changed(self) -> bool:
        """Return true if a number, an attribute or a function has changed since the start."""
        try:
            for container, size, read, before in self._parts:
                if len(container) != size or not all(map(is_, read(container), before)):
                    return True
        except KeyError:  # an attribute was deleted
            return True
        for tensor, address, view, content in self._arrays:
            if tensor is not None and tensor.data_ptr() != address:
                return True
            if view.tobytes() != content:
                return True
        return False

    def digest(self) -> str:
        """Return the SHA-256 of all values except the numbers in tensors.

        Zeros and ones of tensors are included, since code may leave out operations with them.
        """
        return hashlib.sha256(repr([_package(), *self._words]).encode()).hexdigest()

    def _visit(self, value: Any) -> None:
        """Record a value and all values that it refers to."""
        if isinstance(value, _PLAIN):
            self._words.append(value)
        elif id(value) in self._seen:
            self._words.append(f"see {self._seen[id(value)][0]}")
        else:
            self._seen[id(value)] = len(self._seen), value  # keeps the object and its address alive
            self._follow(value)

    def _follow(self, value: Any) -> None:
        if isinstance(value, Tensor):
            self._tensor(value)
        elif isinstance(value, np.ndarray):
            self._words.append((value.dtype.str, value.shape, value.tobytes()))
            self._arrays.append((None, 0, value, value.tobytes()))
        elif isinstance(value, Mapping):
            self._mapping(value)
        elif isinstance(value, (list, tuple, set, frozenset)):
            self._items(value)
        elif isinstance(value, types.FunctionType):
            self._function(value)
        elif isinstance(value, type):
            self._class(value)
        elif getattr(type(value), "is_unwatched", False):
            return
        elif not isinstance(value, (types.ModuleType, types.BuiltinFunctionType)):
            self._object(value)
        else:
            self._words.append(value.__name__)

    def _mapping(self, value: Mapping[Any, Any]) -> None:
        self._part(value, value.keys())
        for key, item in value.items():
            self._words.append(str(key))
            self._visit(item)

    def _items(self, value: Collection[Any]) -> None:
        if isinstance(value, (list, set)):
            self._parts.append((value, len(value), iter, [*value]))
        if isinstance(value, (set, frozenset)):
            value = sorted(value, key=str)
        for item in value:
            self._visit(item)

    def _part(self, mapping: Mapping[str, Any], keys: Iterable[str]) -> None:
        """Watch the number of items of a mapping, and the identity of the values of ``keys``."""
        names = [*keys]
        single = len(names) == 1
        read = itemgetter(*names, *names[:single]) if names else lambda _: ()
        self._parts.append((mapping, len(mapping), read, [*read(mapping)]))

    def _tensor(self, value: Tensor) -> None:
        self.tensors.append(value)
        self._words.append((str(value.dtype), tuple(value.shape), value.stride()))
        if not value.is_cpu:
            return
        view = value.detach().numpy()
        self._arrays.append((value, value.data_ptr(), view, view.tobytes()))
        if view.dtype.kind == "f":
            self._words += [np.packbits(view == number).tobytes() for number in (0, 1, -1)]
        else:
            self._words.append(view.tobytes())

    def _object(self, value: Any) -> None:
        self._words.append(type(value).__qualname__)
        self._visit(type(value))
        skipped = _MODULE if isinstance(value, nn.Module) else frozenset()
        attributes = getattr(value, "__dict__", {})
        names = [name for name in attributes if name not in skipped]
        self._part(attributes, names)
        items = {name: attributes[name] for name in names}
        slots = [x for kind in type(value).__mro__ for x in getattr(kind, "__slots__", ())]
        for name in [*slots, *_MEMBERS.get(type(value), ())]:
            items[name] = getattr(value, name, None)
        for name, item in items.items():
            self._words.append(name)
            self._visit(item)

    def _class(self, kind: type) -> None:
        self._words.append(f"{kind.__module__}.{kind.__qualname__}")
        for base in kind.__mro__:
            if _is_library(base.__module__):
                continue
            members = {x: y for x, y in vars(base).items() if x not in _CLASS}
            self._part(vars(base), members)
            for name, member in members.items():
                self._words.append(name)
                self._visit(member)

    def _function(self, function: types.FunctionType) -> None:
        self._words.append(function.__qualname__)
        if _is_library(function.__module__):
            if function.__closure__ is None:
                return
        else:
            self._words += map(_instructions, _codes(function.__code__))
            self._names(function)
        self._visit(function.__defaults__)
        self._visit(function.__kwdefaults__)
        for cell in function.__closure__ or ():
            self._parts.append(([cell], 1, lambda cells: map(_content, cells), [_content(cell)]))
            self._visit(_content(cell))

    def _names(self, function: types.FunctionType) -> None:
        """Record the global names that a function of the user reads, also in modules."""
        names = {name for code in _codes(function.__code__) for name in code.co_names}
        spaces = [function.__globals__]
        for space in spaces:  # modules are appended during the iteration
            present = sorted(names & space.keys())
            values = [space[name] for name in present]
            self._parts.append((present, len(present), partial(_looked_up, space), values))
            for name in present:
                item = space[name]
                if not isinstance(item, types.ModuleType):
                    self._words.append(name)
                    self._visit(item)
                elif not _is_library(item.__name__):
                    spaces += [vars(item)] * all(x is not vars(item) for x in spaces)


@functools.cache
def _is_library(module: str | None) -> bool:
    """Return true for a module of Python or of an installed package, assumed not to change."""
    package = str(module).partition(".")[0]
    file = getattr(sys.modules.get(package), "__file__", None) or ""
    return module is None or package in _LIBRARIES or "site-packages" in Path(file).parts


def _looked_up(space: Mapping[str, Any], names: Sequence[str]) -> list[Any]:
    return [space.get(name) for name in names]


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not assigned yet
        return None


def _codes(code: types.CodeType) -> list[types.CodeType]:
    """Return the code of a function and of all functions inside it."""
    inner = [x for x in code.co_consts if isinstance(x, types.CodeType)]
    return [code, *(y for x in inner for y in _codes(x))]


def _instructions(code: types.CodeType) -> Any:
    """Return the instructions of a function, without comments and names of files and lines."""
    numbers = [x for x in code.co_consts if not isinstance(x, types.CodeType)]
    return code.co_code, code.co_names, repr(numbers)


@functools.cache
def _package() -> str:
    """Return a digest of the versions of this package (sizes and times of files) and PyTorch."""
    files = sorted(Path(__file__).parents[1].rglob("*.py"))
    states = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    return hashlib.sha256(repr([torch.__version__, *states]).encode()).hexdigest()
