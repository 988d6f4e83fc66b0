"""Files that are whole or absent."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A file that is replaced only by a whole one, whenever its writer is killed or fails.

    Args:
        path: the file; its folder exists.

    Yields:
        ``<name>.<process>.partial`` beside it, to be written; it is then moved into place.

    Raises:
        OSError: where it cannot be written, as on a full disk; names the file.
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        if error.errno is not None:  # what the system says of a write names no file
            error.filename = str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Write a text, in UTF-8, by ``whole``."""
    with whole(path) as partial:
        partial.write_text(text, encoding="utf-8")
