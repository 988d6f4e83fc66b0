"""Imports at first use, since PyTorch Lightning, pandas and SciPy take seconds to import."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any


class LazyNames(dict[str, Any]):
    """Objects by name, each imported at its first use; ``modules`` has their modules."""

    def __init__(self, modules: Mapping[str, str]):
        super().__init__()
        self._modules = modules

    def __missing__(self, name: str) -> Any:
        self[name] = getattr(importlib.import_module(self._modules[name]), name)
        return self[name]


def lazy_attributes(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a ``__getattr__`` for a package that imports its names at their first use."""
    names = LazyNames(modules)

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return names[name]

    return get
