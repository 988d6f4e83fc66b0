"""Log files by their suffix: the registry of readers, and the search for files.

A new format is one function in ``READERS``::

    def read_feather(path, request):
        return pd.read_feather(path)

    READERS[".feather"] = read_feather

A reader of a file with several runs returns a mapping of their names to tables.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pandas as pd

from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.readers.arrays import (
    read_hdf5,
    read_json,
    read_mat,
    read_npy,
    read_npz,
    read_torch,
)
from pinn_dyn.data.logs.readers.bags import read_bag
from pinn_dyn.data.logs.readers.parquet import read_parquet
from pinn_dyn.data.logs.readers.text import read_text
from pinn_dyn.data.logs.table import Request, Table

Reader = Callable[[Path, Request], "pd.DataFrame | Table | Mapping[str, pd.DataFrame | Table]"]
"""Function that reads a file, or the runs of a file by name.

A table has a row per sample. Messages name rows by the index of the table.
"""

READERS: dict[str, Reader] = {
    **dict.fromkeys((".csv", ".gz", ".txt", ".tsv", ".dat", ".log"), read_text),
    **dict.fromkeys((".asc", ".lvm", ".mot", ".prn", ".sto", ".tab"), read_text),
    ".mat": read_mat,
    **dict.fromkeys((".h5", ".hdf5"), read_hdf5),
    ".npz": read_npz,
    ".npy": read_npy,
    **dict.fromkeys((".pt", ".pth"), read_torch),
    **dict.fromkeys((".json", ".jsonl"), read_json),
    ".parquet": read_parquet,
    **dict.fromkeys((".bag", ".mcap", ".db3"), read_bag),
}
"""Reader of each suffix. The folder of a ROS 2 bag is read as ``.db3``."""
_PACKED = (".zip", ".tar", ".tgz", ".7z", ".rar", ".xz", ".bz2", ".zst")


def _is_bag(path: Path) -> bool:
    """Return true for the folder of a bag with an identifier of its storage, which may be lost."""
    metadata = path / "metadata.yaml"
    text = metadata.read_text() if metadata.is_file() else ""
    return bool(re.search(r"storage_identifier: *[\"']?\w", text))


def read_tables(path: Path, request: Request) -> dict[str, Table]:
    """Read a log file. Return its table under the name ``""``, or a table per run.

    Raises:
        LogError: if no reader knows the format, or the file is damaged or empty.
    """
    suffix = ".db3" if _is_bag(path) else path.suffix.lower().replace(".active", ".bag")
    if suffix not in READERS:
        cure = f"save the log as one of {', '.join(READERS)}"
        if suffix in _PACKED:
            cure = "unpack it, and name the files in it"
        raise LogError(f"{path}: no reader for {suffix!r}: {cure}")
    try:
        content = READERS[suffix](path, request)
    except Exception as error:  # a damaged file raises nearly anything
        if isinstance(error, LogError):
            raise
        text = " ".join(str(error).split()) or type(error).__name__
        cause = "save plain arrays:" if "allow_pickle" in text else "is it cut short?"
        if suffix == ".bag":
            rename = f" and rename it to {path.stem}" if path.suffix != ".bag" else ""
            cause += f" Repair it by rosbag reindex {path.name}{rename}:"
        raise LogError(f"{path}: cannot be read as {suffix}, {cause} {text}") from error
    tables = content if isinstance(content, Mapping) else {"": content}
    if not any(map(len, tables.values())):
        raise LogError(f"{path}: the file has no rows")
    return {run: _table(path, run, x) for run, x in tables.items() if len(x)}


def _table(path: Path, run: str, content: pd.DataFrame | Table) -> Table:
    if isinstance(content, Table):
        return content
    name = f"{path}, run {run}" if run else str(path)
    return Table(content, name, notes=content.attrs.get("notes", ()))


def find_files(root: str, patterns: str | Sequence[str]) -> list[Path]:
    """Return the sorted files that match names or glob patterns in a folder, or absolute paths.

    Raises:
        LogError: if the folder does not exist, or a pattern matches nothing.
    """
    folder = Path(root).expanduser()
    if not folder.is_dir():
        raise LogError(
            f"root is {str(folder.absolute())!r}, which is no folder (default: PINN_DYN_LOGS)"
        )
    files: set[Path] = set()
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        matches = []
        start = Path(pattern).expanduser()
        names = start.relative_to(start.anchor)  # a pattern below the root of an absolute path
        for path in (folder / start.anchor).glob(str(names)):
            parts = [*path.glob("*.mcap"), *path.glob("*.db3")]  # files of a bag without metadata
            matches += [path] if path.is_file() or _is_bag(path) else parts
        if not matches:
            present = listed(sorted(path.name for path in folder.iterdir()))
            raise LogError(
                f"files: nothing matches {pattern!r} in the folder {folder.absolute()}: {present}"
            )
        files.update(matches)
    return sorted(files)


def run_name(path: Path, root: str) -> str:
    """Return the name of a run: the file's path in the folder, or its name, without suffix."""
    folder = Path(root).expanduser()
    inside = path.relative_to(folder) if path.is_relative_to(folder) else Path(path.name)
    return (inside.with_suffix("") if inside.suffix == ".gz" else inside).with_suffix("").as_posix()
