"""Imports at first use, since PyTorch Lightning, pandas and SciPy take seconds to import."""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from importlib.util import resolve_name
from pathlib import Path
from typing import Any


def imported_names(node: ast.AST, package: str) -> dict[str, str]:
    """Return the path of each name that the import statements within a node bind."""
    names: dict[str, str] = {}
    for item in ast.walk(node):
        if isinstance(item, ast.ImportFrom):
            source = resolve_name("." * item.level + (item.module or ""), package)
            names |= {x.asname or x.name: f"{source}.{x.name}" for x in item.names}
        elif isinstance(item, ast.Import):
            names |= {x.asname or x.name: x.name for x in item.names}
    return names


class LazyNames(dict[str, Any]):
    """Objects that a module imports under ``if TYPE_CHECKING:``, each imported at its first use."""

    def __init__(self, module: str):
        super().__init__()
        file = str(getattr(sys.modules[module], "__file__", ""))
        tree = ast.parse(Path(file).read_text("utf-8") if file.endswith(".py") else "")
        self.paths: dict[str, str] = {}
        for block in tree.body:
            if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
                self.paths |= imported_names(block, module)

    def __missing__(self, name: str) -> Any:
        module, _, attribute = self.paths[name].rpartition(".")
        self[name] = getattr(importlib.import_module(module), attribute)
        return self[name]


def lazy_attributes(package: str) -> Callable[[str], Any]:
    """Return a ``__getattr__`` that imports the names of ``if TYPE_CHECKING:`` at first use."""
    objects = LazyNames(package)

    def get(name: str) -> Any:
        if name not in objects.paths:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return objects[name]

    return get
