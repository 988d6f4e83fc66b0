"""Settings in messages: keys and YAML on the command line, arguments in Python."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

_reader = {"types": "python"}


@contextlib.contextmanager
def command_line() -> Iterator[None]:
    """Word the messages within a context for the command line."""
    before = _reader["types"]
    _reader["types"] = "yaml"
    try:
        yield
    finally:
        _reader["types"] = before


def in_python() -> bool:
    """Tell whether the reader of messages writes Python."""
    return _reader["types"] == "python"


def setting(path: str, *value: Any) -> str:
    """Return a key such as ``model.springs``, with its value if any; its last part in Python."""
    name = path.partition(".")[2] if in_python() else path
    return "=".join([name, *map(_text, value)])


def mapping(key: str, values: Mapping[str, Any]) -> str:
    """Return a setting with several values, such as ``time: {rate: 100}``."""
    if in_python():
        return f"{key}={dict(values)!r}"
    return f"{key}: {_text(values)}"


def step(kind: str, **values: Any) -> str:
    """Return a cleaning step of a log, a class of :mod:`pinn_dyn.data.logs`."""
    path = f"pinn_dyn.data.logs.{kind}"
    if in_python():
        return f"{path}({', '.join(f'{key}={value!r}' for key, value in values.items())})"
    return _text({"_target_": path, **values})


def entry(name: str, text: str, comment: str = "") -> str:
    """Return the line of a named step."""
    line = f'"{name}": {text},' if in_python() else f"{name}: {text}"
    return f"{line} # {comment}" if comment else line


def steps(entries: Sequence[str]) -> str:
    """Return the setting of the cleaning steps of a log, a block of lines."""
    if in_python():
        lines = [f"    {line}" for line in entries]
        return "\n".join(["cleaning={ # steps={ of a LogSource", *lines, "}"])
    return "\n".join(["steps:", *(f"  {line}" for line in entries)])


def _text(value: Any) -> str:
    """Return a value as the reader writes it."""
    if in_python():
        return repr(value)
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key}: {_text(x)}' for key, x in value.items())}}}"
    return f"[{','.join(map(_text, value))}]" if isinstance(value, list) else str(value)
