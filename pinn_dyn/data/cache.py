"""Disk cache for arrays that take long to compute."""

from __future__ import annotations

import contextlib
import dataclasses
import glob
import hashlib
import json
import logging
import os
import types
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock

from pinn_dyn.atomic_files import whole

log = logging.getLogger(__name__)

Arrays = Mapping[str, np.ndarray]
_ROUNDING = 1e-9


def cache_key(description: object) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of a JSON-serializable description."""
    text = json.dumps(description, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def load_or_make(
    folder: Path,
    name: str,
    description: object,
    make: Callable[[], Arrays],
    prove: Callable[[Arrays], np.ndarray] | None = None,
) -> Arrays:
    """Load the arrays of a description from the cache, or make and store them.

    The file ``<name>-<key>.npz`` has no pickled objects. Readers never see an incomplete file. A
    single process makes the file while others wait. A damaged file is made again. A read-only
    folder is only read.

    Args:
        folder: the cache folder, created if missing.
        name: first part of the file name.
        description: all values that determine the arrays, JSON-serializable.
        make: function that makes the arrays.
        prove: function that computes numbers from stored arrays with the current code. The numbers
            are stored as ``proof``. If a proof differs by more than rounding, the arrays are made
            again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}-{cache_key(description)}.npz"
    is_read_only = path.exists() and not os.access(folder, os.W_OK)
    with contextlib.nullcontext() if is_read_only else FileLock(f"{path}.lock"):
        stored = _stored(path, prove)
        if stored is not None:
            return stored
        arrays = dict(make())
        if prove is not None:
            arrays["proof"] = prove(arrays)
        if not is_read_only:
            # The holder of the lock is the only writer; other files are of killed processes.
            for partial in folder.glob(f"{glob.escape(path.name)}.*.partial"):
                partial.unlink(missing_ok=True)
            with whole(path) as partial, partial.open("wb") as file:
                np.savez(file, allow_pickle=False, **arrays)
    return arrays


def _stored(path: Path, prove: Callable[[Arrays], np.ndarray] | None) -> Arrays | None:
    """Return stored arrays with the current proof; None without such arrays, with a warning."""
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = dict(archive)  # reads each member to its end, where its checksum is
    except Exception as error:  # a damaged archive raises nearly anything
        log.warning("cache file %s is damaged (%s): it is made again", path, error)
        return None
    if prove is None or _agree(arrays["proof"], prove(arrays)):
        return arrays
    log.warning(
        "the recording %s differs from the current code of its robot and excitation: "
        "it is made again",
        path,
    )
    return None


def _agree(stored: np.ndarray, present: np.ndarray) -> bool:
    scale = _ROUNDING * np.abs(stored).max(initial=0.0, where=np.isfinite(stored))
    return stored.shape == present.shape and np.allclose(
        present, stored, rtol=_ROUNDING, atol=scale, equal_nan=True
    )


_MODULE_ATTRIBUTES = frozenset(vars(torch.nn.Module()))


def describe(value: object) -> Any:
    """Describe a value as JSON: an object by its class and its ``describe()`` or its attributes.

    A class or a function is described only by its name. Changes of its code are detected by the
    proof of a recording (:func:`~pinn_dyn.data.cache.load_or_make`).

    Raises:
        TypeError: if an object cannot be pickled; give its class a method ``describe()``.
    """
    return plain(value, _described_object)


def plain(value: object, describe_object: Callable[[Any], Any]) -> Any:
    """Convert tensors, mappings and sequences to JSON, and all other objects by a function."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (torch.Tensor, np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(item, describe_object) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [plain(item, describe_object) for item in value]
    return describe_object(value)


def _described_object(value: Any) -> Any:
    if isinstance(value, (type, types.FunctionType)):
        return value.__qualname__
    if hasattr(value, "describe"):
        settings = value.describe()
    elif isinstance(value, torch.nn.Module):
        settings = {k: item for k, item in vars(value).items() if k not in _MODULE_ATTRIBUTES}
        settings |= {**value._parameters, **value._buffers, **value._modules}
    elif dataclasses.is_dataclass(value):
        settings = {item.name: getattr(value, item.name) for item in dataclasses.fields(value)}
    else:
        return describe(value.__reduce_ex__(2))
    return {"class": type(value).__qualname__, **describe(settings)}
