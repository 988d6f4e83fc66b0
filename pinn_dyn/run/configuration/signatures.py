"""Arguments of classes, read from their source, since PyTorch and others take seconds to import."""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from difflib import get_close_matches
from importlib.abc import InspectLoader
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from typing import Any

from pinn_dyn.lazy_imports import imported_names

STAND_INS: dict[Any, type] = {}
"""Names of classes of other packages, and dataclasses with the arguments to accept for them."""
_ABSTRACT = ("ABC", "abc.ABC", "Generic", "Protocol")
Arguments = dict[str, str | None]
"""Names of arguments, each with the path of the class that a mapping may describe, or None."""


def unknown_keys(
    value: Any, target: str | None = None, path: str = ""
) -> Iterator[tuple[str, Arguments]]:
    """Iterate over keys that are no arguments of their ``_target_``, each with the arguments.

    ``target`` is the path of the class that a mapping without ``_target_`` describes.
    """
    if isinstance(value, list):
        for index, item in enumerate(value):
            yield from unknown_keys(item, None, f"{path}[{index}]")
    if not isinstance(value, dict):
        return
    arguments = _arguments(str(value.get("_target_", target)))
    keys = value.keys() - {"_target_", "_partial_"}
    if arguments and keys.isdisjoint(arguments):
        single = len(keys) == 1 and get_close_matches(str(*keys), arguments)
        # Otherwise it is probably the wrong class, which the full check names.
        arguments = arguments if single else None
    for key, item in value.items():
        inner = f"{path}.{key}" if path else str(key)
        if arguments is None or key in arguments:
            yield from unknown_keys(item, (arguments or {}).get(key), inner)
        elif key in keys:
            yield inner, arguments


@functools.cache
def _arguments(path: str) -> Arguments | None:
    """Return the arguments of a class or function; None if the source does not tell them all."""
    if kind := STAND_INS.get(path):
        path = f"{kind.__module__}.{kind.__qualname__}"
    module, node = definition(path)
    fields: list[ast.AnnAssign | ast.arg] = []
    arguments: Arguments = {}
    if isinstance(node, ast.ClassDef):
        decorators = {ast.unparse(x).partition("(")[0] for x in node.decorator_list}
        if node.keywords or not decorators <= {"dataclass", "dataclasses.dataclass"}:
            return None
        functions = {x.name: x for x in node.body if isinstance(x, ast.FunctionDef)}
        if "__init__" not in functions:
            for base in reversed(node.bases):
                name = ast.unparse(base).partition("[")[0]
                inherited = {} if name in _ABSTRACT else _arguments(f"{module}.{name}")
                if inherited is None:
                    return None
                arguments |= inherited
            fields += [x for x in node.body if isinstance(x, ast.AnnAssign)]
        node = functions.get("__init__")
    elif node is None:
        return None
    if isinstance(node, ast.FunctionDef):
        if node.args.kwarg is not None or node.decorator_list:
            return None
        fields += [x for x in (*node.args.args, *node.args.kwonlyargs) if x.arg != "self"]
    for field in fields:
        name = field.arg if isinstance(field, ast.arg) else ast.unparse(field.target)
        text = ast.unparse(field.annotation) if field.annotation else ""
        match = re.match(r"(\w+) \|.*\bMapping\[str, Any\]", text)
        arguments[name] = f"{module}.{match[1]}" if match else None
    return arguments


def definition(path: str) -> tuple[str, ast.AST | None]:
    """Return the definition of a class or function, and its module; follow imports."""
    module, _, name = path.rpartition(".")
    while module and _spec(module) is None:
        module, _, head = module.rpartition(".")
        name = f"{head}.{name}"
    tree, names = _source(module)
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            return module, node
    head, dot, tail = name.partition(".")
    target = f"{names[head]}{dot}{tail}" if head in names else path
    return (path, None) if target == path else definition(target)


@functools.cache
def _source(module: str) -> tuple[ast.Module, dict[str, str]]:
    """Return the syntax tree of a module, and the paths of the names that it imports."""
    spec = _spec(module)
    has_source = spec is not None and isinstance(spec.loader, InspectLoader)
    text = spec.loader.get_source(module) if has_source else None  # type: ignore[union-attr]
    tree = ast.parse(text or "")  # no text of a module in C
    return tree, imported_names(tree, spec.parent or "" if spec else "")


@functools.cache
def _spec(module: str) -> ModuleSpec | None:
    """Return the place of a module, without the import of its packages by ``find_spec``."""
    if package := module.rpartition(".")[0]:
        folders = getattr(_spec(package), "submodule_search_locations", None)
        return PathFinder.find_spec(module, folders) if folders else None
    try:
        return None if module == "__main__" else find_spec(module)
    except ValueError:  # a module that was made in Python
        return None
