"""Imports at first use, since PyTorch Lightning, pandas and SciPy take seconds to import."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any


class LazyNames(dict[str, Any]):
    """Objects by name, each imported at its first use; ``names`` lists those of each module."""

    def __init__(self, names: Mapping[str, str]):
        super().__init__()
        self.modules = {name: module for module in names for name in names[module].split()}

    def __missing__(self, name: str) -> Any:
        self[name] = getattr(importlib.import_module(self.modules[name]), name)
        return self[name]


def lazy_attributes(package: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a ``__getattr__`` for a package that imports its names at their first use."""
    objects = LazyNames(names)

    def get(name: str) -> Any:
        if name not in objects.modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return objects[name]

    return get
