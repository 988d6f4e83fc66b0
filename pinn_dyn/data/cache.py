"""Disk cache for arrays that take long to make."""

from __future__ import annotations

import glob
import hashlib
import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from filelock import FileLock

from pinn_dyn.data.whole import whole

log = logging.getLogger(__name__)

Arrays = Mapping[str, np.ndarray]


def cache_key(description: object) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of a JSON-serializable description."""
    text = json.dumps(description, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def load_or_make(
    folder: Path, name: str, description: object, make: Callable[[], Arrays]
) -> Arrays:
    """Load the arrays of a description from the cache, or make and store them.

    A file is ``<name>-<key>.npz``: plain arrays without pickle, with their description. It is
    written under another name and moved into place, so that a reader never sees half a file. A lock
    lets one process make the file while others wait. Reading compares the archive's checksums and
    the description. A damaged file, or one of other data, is reported, kept as ``.damaged`` and
    made again. A read-only folder is only read.

    Args:
        folder: the cache folder, made if missing.
        name: first part of the file name.
        description: everything that the arrays depend on, JSON-serializable.
        make: function that makes the arrays.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}-{cache_key(description)}.npz"
    if path.exists() and not os.access(folder, os.W_OK):
        return _read(path, description)
    with FileLock(f"{path}.lock"):
        if path.exists():
            try:
                return _read(path, description)
            except Exception as error:  # a damaged archive raises nearly anything
                aside = path.with_suffix(".damaged")
                os.replace(path, aside)
                log.warning(
                    "cache file %s is damaged (%s); kept as %s and made again",
                    path,
                    error,
                    aside.name,
                )
        # The holder of the lock is the only writer; other files are of killed processes.
        for partial in folder.glob(f"{glob.escape(path.name)}.*.partial"):
            partial.unlink(missing_ok=True)
        arrays = make()
        _write(path, arrays, description)
    return arrays


def _read(path: Path, description: object) -> Arrays:
    # numpy reads each member to its end, where zipfile compares the checksum.
    with np.load(path, allow_pickle=False) as archive:
        written = json.loads(str(archive["description"]))
        if cache_key(written) != cache_key(description):
            raise ValueError(
                f"it holds the data of another description, {json.dumps(written)[:200]}, expected "
                f"{json.dumps(description)[:200]}"
            )
        return {str(name): archive[str(name)] for name in archive["names"]}


def _write(path: Path, arrays: Arrays, description: object) -> None:
    with whole(path) as partial, partial.open("wb") as file:
        # The names tell a reader what must be there, should the archive's directory be damaged.
        members = {
            "description": np.array(json.dumps(description)),
            "names": np.array(list(arrays)),
            **arrays,
        }
        np.savez(file, allow_pickle=False, **members)
