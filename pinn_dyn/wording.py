"""Words of messages: settings as the reader writes them, and suggestions for misspelled names."""

from __future__ import annotations

import contextlib
import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from typing import Any

IN_YAML = ContextVar("IN_YAML", default=False)
"""True where the reader of messages writes YAML and keys of the command line."""


@contextlib.contextmanager
def command_line() -> Iterator[None]:
    """Word the messages within a context for the command line."""
    token = IN_YAML.set(True)
    try:
        yield
    finally:
        IN_YAML.reset(token)


def setting(path: str, *value: Any) -> str:
    """Return a key, such as ``dataset.u.unit``, or with a value, ``model.springs=[elbow]``.

    In Python the section is left out, and of a setting with a value all but the argument.
    """
    if not IN_YAML.get():
        path = path.rpartition(".")[2] if value else path.partition(".")[2]
    return "=".join([path, *map(_text, value)])


def entry(key: str, value: Any) -> str:
    """Return a setting of a data set, such as ``time: {rate: 100}``, without quotes for a text."""
    text = value if isinstance(value, str) else _text(value)
    return f"{key}: {text}" if IN_YAML.get() else f"{key}={text}"


def step(kind: str, **values: Any) -> str:
    """Return a cleaning step of a log, a class of :mod:`pinn_dyn.data.logs`."""
    path = f"pinn_dyn.data.logs.{kind}"
    if IN_YAML.get():
        return _text({"_target_": path, **values})
    return f"{path}({', '.join(entry(key, repr(x)) for key, x in values.items())})"


def line(key: str, value: Any, comment: str = "") -> str:
    """Return a line with a setting, as :func:`entry`, in a block of settings."""
    text = entry(key, value) if IN_YAML.get() else f"{entry(key, value)},"
    return f"{text}  # {comment}" if comment else text


def steps(lines: Sequence[str]) -> str:
    """Return the setting of the cleaning steps of a log from its lines."""
    start, end = ("steps:", "") if IN_YAML.get() else ("cleaning=dict(", "\n),")
    return start + "".join(f"\n  {line}" for line in lines) + end


def _text(value: Any) -> str:
    """Return a value as the reader writes it."""
    if not IN_YAML.get():
        return repr(value)
    if isinstance(value, Mapping):
        return f"{{{', '.join(entry(key, x) for key, x in value.items())}}}"
    if isinstance(value, list):
        return f"[{','.join(map(_text, value))}]"
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def did_you_mean(name: object, names: Iterable[str]) -> str:
    """Return the names that resemble one, as the end of a sentence; "" without any.

    Names that differ in case, blanks, quotes or a unit in brackets alone come first.
    """
    names, plain = list(names), _plain(name)
    equal = [x for x in names if plain and _plain(x) == plain]
    close = equal or difflib.get_close_matches(str(name), names)
    return f": did you mean {' or '.join(close)}?" if close else ""


def _plain(name: object) -> str:
    return re.sub(r"[\[(]\D*[\])]|[\s\"'_]", "", str(name)).lower()
