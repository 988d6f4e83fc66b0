"""Files of named arrays as tables: MATLAB, HDF5 and NPZ.

An array with as many rows as the time is a column; one with several columns is ``name_1``,
``name_2`` and so on. Parts of structs and groups are joined: ``log.q`` in MATLAB,
``log/q`` in HDF5.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.io import loadmat

from pinn_dyn.data.logs.bags import optional
from pinn_dyn.data.logs.errors import LogError, listed, most_bytes
from pinn_dyn.data.logs.mat_elements import check_elements
from pinn_dyn.spelling import did_you_mean

_DEEPEST = 30
_KINDS = {
    "c": "holds complex numbers",
    "O": "is a cell array, such as of ragged rows",
    "U": "is a text",
    "S": "is a text",
}


@dataclass(frozen=True)
class _Found:
    """The arrays of a file by their names, and why others are none."""

    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    unusable: dict[str, str] = field(default_factory=dict)

    def add_member(self, file: Any, name: str) -> None:
        """An array of an NPZ file, or why it is none."""
        entry = file.zip.getinfo(name if name in file.zip.namelist() else f"{name}.npy")
        if entry.file_size > most_bytes(entry.compress_size):
            large = f"has {entry.file_size} bytes in {entry.compress_size} compressed ones"
            self.unusable[name] = large
            return
        try:
            value = file[name]
        except MemoryError:
            self.unusable[name] = "claims to be larger than the memory"
        except Exception:  # a damaged header raises nearly anything
            self.unusable[name] = "is damaged or holds Python objects, which are never unpickled"
        else:
            if isinstance(value, np.ndarray):
                self.add(name, value)
            else:
                self.unusable[name] = "is no array"

    def flatten(self, name: str, value: Any) -> None:
        """Matrices of a variable and of the fields of its structs, as ``log.q``; else why not."""
        if isinstance(value, Mapping):
            for key, inner in value.items():
                self.flatten(f"{name}.{key}", inner)
            return
        value = np.asarray(value, dtype=None if not isinstance(value, list) else object)
        if value.dtype.names:
            several = f"is a field of an array of {value.size} structs"
            for key in value.dtype.names:
                if value.size == 1:
                    self.flatten(f"{name}.{key}", value.flat[0][key])
                else:
                    self.unusable[f"{name}.{key}"] = several
        else:
            self.add(name, value)

    def add(self, name: str, value: np.ndarray) -> None:
        """A real vector or matrix; else why it is none."""
        if value.dtype.kind not in "fiub":
            self.unusable[name] = _KINDS.get(value.dtype.kind, f"has the type {value.dtype}")
        elif value.ndim not in (1, 2):
            self.unusable[name] = f"has {value.ndim} dimensions"
        else:
            self.arrays[name] = value if value.ndim == 2 else value[:, None]

    def table(self, path: Path, time: str) -> pd.DataFrame:
        """The arrays that have as many rows as the time."""
        arrays, unusable = self.arrays, self.unusable
        if time in unusable:
            said = f"{path}, variable {time!r} (time): {unusable[time]}"
            raise LogError(f"{said}, expected real numbers")
        if time not in arrays:
            names = listed(f"{name} {value.shape}" for name, value in arrays.items())
            hint = did_you_mean(time, arrays) or "."
            raise LogError(f"{path}: no variable {time!r} for the time{hint} The file has {names}")
        samples = arrays[time].size
        columns: dict[str, np.ndarray] = {}
        for name, value in arrays.items():
            rows = value if value.shape[0] == samples else value.T
            if rows.shape[0] != samples:  # parameters and the like
                size = " by ".join(map(str, value.shape))
                unusable[name] = f"is {size}, and the time has {samples} samples"
                continue
            single = rows.shape[1] == 1
            for k in range(rows.shape[1]):
                column = name if single else f"{name}_{k + 1}"
                if column in columns:
                    unusable[column] = "is a column of a matrix and a variable of its own"
                columns[column] = rows[:, k]
        for column in unusable.keys() & columns.keys():
            del columns[column]
        table = pd.DataFrame(columns, index=pd.RangeIndex(1, samples + 1))
        table.attrs["unusable"] = unusable
        return table


def read_arrays(path: Path, time: str) -> pd.DataFrame:
    """The arrays of a file of one of the ``ARRAY_SUFFIXES``; objects are never unpickled.

    Raises:
        LogError: if it cannot be read, or has no such time.
    """
    found = _Found()
    kind, read = _READERS[path.suffix]
    try:
        read(path, found)
    except LogError:
        raise
    except Exception as error:  # a damaged file raises nearly anything
        raise LogError(f"{path}: cannot be read as {kind}: {error}") from error
    return found.table(path, time)


def _read_mat(path: Path, found: _Found) -> None:
    try:
        check_elements(path)
        content = loadmat(path, squeeze_me=False, struct_as_record=True)
    except NotImplementedError:  # version 7.3 is HDF5
        content = optional("pymatreader", path).read_mat(str(path))
    for name, value in content.items():
        if not name.startswith("__"):
            found.flatten(name, value)


def _read_hdf5(path: Path, found: _Found) -> None:
    h5py = optional("h5py", path)

    def visit(name: str, item: Any) -> str | None:
        if name.count("/") > _DEEPEST:
            return name
        if isinstance(item, h5py.Group):
            found.unusable[name] = f"is a group that holds {listed(item) or 'nothing'}"
        elif not isinstance(item, h5py.Dataset):
            found.unusable[name] = "is a description of a type"
        elif item.external:
            found.unusable[name] = "lies in another file, which is not opened"
        elif item.nbytes > most_bytes(item.id.get_storage_size()):
            found.unusable[name] = f"claims {item.nbytes} bytes, far more than the file has of it"
        elif item.dtype.names or item.dtype.kind not in "fiub":
            found.unusable[name] = f"has the type {item.dtype}"
        else:
            found.add(name, np.asarray(item[()]))
        return None

    with h5py.File(path, "r") as file:
        if file.visititems(visit) is not None:
            raise LogError(f"{path}: has groups more than {_DEEPEST} levels deep, expected a log")


def _read_npz(path: Path, found: _Found) -> None:
    with np.load(path, allow_pickle=False) as file:
        for name in file.files:
            found.add_member(file, name)


_READERS: dict[str, tuple[str, Callable[[Path, _Found], None]]] = {
    ".mat": ("a MATLAB file", _read_mat),
    ".h5": ("HDF5, it may be cut short", _read_hdf5),
    ".hdf5": ("HDF5, it may be cut short", _read_hdf5),
    ".npz": ("NPZ, it may be cut short", _read_npz),
}
ARRAY_SUFFIXES = tuple(_READERS)
