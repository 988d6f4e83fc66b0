"""Files that are whole or absent, and files of others."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

_LARGEST = 2**26
"""Largest size of a text file of a run folder, bytes."""


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Replace a file or an empty folder only by a complete one, also if the writer is killed.

    Yields:
        Path of ``<name>.<process>.partial`` to write to; it is moved into place afterwards.
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        if error.errno is not None:  # the system does not name the file
            error.filename = str(path)
        raise
    finally:
        if partial.is_dir():
            shutil.rmtree(partial)
        partial.unlink(missing_ok=True)


def read_regular(path: Path) -> str:
    """Return the text of a file that others wrote; refuse pipes, devices and huge files."""
    if path.exists() and not (path.is_file() and path.stat().st_size <= _LARGEST):
        raise ValueError(f"{path} is not read, expected a regular file of at most {_LARGEST} bytes")
    return path.read_text(encoding="utf-8", errors="replace")


def write_whole(path: Path, text: str) -> None:
    """Write a text in UTF-8 with :func:`whole`."""
    with whole(path) as partial:
        partial.write_text(text, encoding="utf-8")


def save_whole(path: Path, content: Any) -> None:
    """Save tensors and plain values with :func:`whole`."""
    buffer = io.BytesIO()  # torch.save itself says nothing of a full disk
    torch.save(content, buffer)
    with whole(path) as partial, partial.open("wb") as file:
        file.write(buffer.getbuffer())
        file.flush()
        os.fsync(file.fileno())
