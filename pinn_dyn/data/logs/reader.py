"""Finds log files and reads their columns, CSV here and the other formats by their own modules."""

from __future__ import annotations

import csv
import gzip
import io
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pandas as pd

from pinn_dyn.data.logs.arrays import ARRAY_SUFFIXES, read_arrays
from pinn_dyn.data.logs.bags import BAG_SUFFIXES, is_bag, read_bag
from pinn_dyn.data.logs.errors import LogError, listed, most_bytes, shown
from pinn_dyn.data.logs.parquet import read_parquet
from pinn_dyn.data.logs.table import Table

_PART = 200_000  # rows of a CSV file that are parsed together
_LONGEST_HEADER = 130_000
_MOST_COLUMNS = 10_000
# What a file that is no text begins with, and what to do with it.
_NO_TEXT = {
    b"\x1f\x8b": "it is packed by gzip: end its name in .gz, or unpack it",
    b"PK\x03\x04": "it is a zip archive, or a table of Excel: unpack it, or save it as CSV",
    b"\xfd7zXZ": "it is packed by xz: unpack it",
    b"BZh": "it is packed by bzip2: unpack it",
    b"(\xb5/\xfd": "it is packed by zstd: unpack it",
    b"\x00\x05\x16\x07": "macOS writes such files beside others: delete it",
}
# Files of others, by their suffix, and what makes a table of them that can be read.
_CONVERTED = {
    ".ulg": "by 'ulog2csv' of the package pyulog, a CSV file for each topic",
    ".pkl": "pandas.read_pickle(...).to_parquet('run.parquet'), if you trust its author",
    ".tdms": "nptdms.TdmsFile.read(...).as_dataframe().to_parquet('run.parquet')",
    ".json": "pandas.read_json(...).to_parquet('run.parquet')",
    ".xlsx": "pandas.read_excel(...).to_csv('run.csv', index=False)",
    ".feather": "pandas.read_feather(...).to_parquet('run.parquet')",
    ".npy": "numpy.savez('run.npz', t=..., q=..., u=...)",
}
_CONVERTED |= {
    alike: _CONVERTED[one]
    for alike, one in ((".pickle", ".pkl"), (".jsonl", ".json"), (".xls", ".xlsx"))
}
_TEXT = ("", ".csv", ".gz", ".txt", ".tsv", ".dat", ".log")
FORMATS = (
    "CSV (also as .csv.gz), MATLAB (.mat), HDF5 (.h5, .hdf5), NPZ, Parquet, and bags of ROS (.bag, "
    ".mcap, .db3, or the folder of a bag with its metadata.yaml)"
)


def find_files(root: str, patterns: str | Sequence[str]) -> list[Path]:
    """The files of names or glob patterns in a folder, in order of their names.

    Raises:
        LogError: if the folder does not exist, or a pattern finds nothing there or leads out of it.
    """
    folder = Path(root).expanduser()
    if not folder.is_dir():
        raise LogError(
            f"root is {str(folder.absolute())!r}, which is no folder: give the folder of the logs "
            "as dataset.root=..., or set the variable PINN_DYN_LOGS where the data set uses it"
        )
    found: set[Path] = set()
    given = (
        [patterns] if not isinstance(patterns, Sequence) or isinstance(patterns, str) else patterns
    )
    if not given or not all(isinstance(pattern, str) and pattern for pattern in given):
        raise LogError(f"files is {shown(patterns)}, expected names or patterns, as '*.csv'")
    for pattern in given:
        if Path(pattern).is_absolute() or ".." in Path(pattern).parts:
            raise LogError(f"files has {pattern!r}, expected paths from the folder root")
        try:
            named = list(folder.glob(pattern))
        except OSError:  # as of a name that no file can have
            named = []
        matches = [path for path in named if path.is_file() or is_bag(path)]
        if not matches:
            raise LogError(
                f"files: nothing matches {shown(pattern)} in the folder {folder.absolute()}"
                f"{_inside(folder, named) or _there(folder)}"
            )
        found.update(matches)
    return sorted(found)


def _there(folder: Path) -> str:
    """What the folder has instead."""
    names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    has = f"has {listed(names)}" if names else "is empty"
    return f", which {has}: mend dataset.files or dataset.root"


def _inside(folder: Path, named: Sequence[Path]) -> str:
    """What to write instead of a folder that is no bag."""
    for path in named:
        suffixes = [file.suffix for file in sorted(path.glob("*")) if file.is_file()]
        if path.is_dir() and suffixes:
            inner = next((x for x in suffixes if x in BAG_SUFFIXES), suffixes[0])
            bag = " without metadata.yaml, which a bag has" if inner in BAG_SUFFIXES else ""
            return (
                f", but a folder{bag}: name the files in it, as "
                f"'{path.relative_to(folder).as_posix()}/*{inner}'"
            )
    return ""


def run_name(path: Path, root: str) -> str:
    """The name of a file's run: its path from the folder, without its suffix."""
    inside = path.relative_to(Path(root).expanduser())
    return (inside.with_suffix("") if inside.suffix == ".gz" else inside).with_suffix("").as_posix()


def read_table(path: Path, time: str, columns: Sequence[str], max_age: float) -> Table:
    """Read columns of a file.

    Args:
        path: the file.
        time: column of the time.
        columns: what will be asked for; files whose columns cost little give all that they have.
        max_age: how old a message of another topic of a bag may be, s.

    Raises:
        LogError: if the file cannot be read or is empty.
    """
    frame = _read(path, time, columns, max_age)
    unusable, notes = (frame.attrs.get(key, {}) for key in ("unusable", "notes"))
    return Table(frame, str(path), "line", unusable, list(notes))


def _read(path: Path, time: str, columns: Sequence[str], max_age: float) -> pd.DataFrame:
    if is_bag(path):
        return read_bag(path, time, columns, max_age)
    if path.suffix in ARRAY_SUFFIXES:
        return read_arrays(path, time)
    if path.suffix == ".parquet":
        return read_parquet(path)
    if (how := _CONVERTED.get(path.suffix.lower())) is not None:
        raise LogError(f"{path}: {path.suffix} is not read, but {FORMATS}: convert it, {how}")
    try:
        return _read_csv(path)
    except LogError as error:
        if path.suffix.lower() in _TEXT:
            raise
        raise LogError(
            f"{error}. What is read is {FORMATS}: convert other files, as by pandas, whose tables "
            "have to_csv and to_parquet"
        ) from error


def _parsed(file: BinaryIO, separator: str) -> pd.DataFrame:
    """The table of a CSV file, parsed in parts: at once it takes three times its memory."""

    def parser(rows: int | None) -> Any:
        file.seek(0)
        return pd.read_csv(
            file,
            sep=separator,
            encoding="utf-8-sig",
            skipinitialspace=True,
            skip_blank_lines=False,
            low_memory=False,
            index_col=False,
            chunksize=rows,
        )

    numeric: dict[Any, np.ndarray] = {}
    texts: dict[Any, list[pd.Series]] = {}
    names: list[Any] = []
    with parser(_PART) as reader:
        for part in reader:
            first, names = not names, list(part.columns)
            for name, one in part.items():
                if one.dtype.kind in "iuf" and (first or name in numeric):
                    numeric[name] = _longer(numeric.get(name), one.to_numpy())
                elif first or (name in texts and texts[name][0].dtype == one.dtype):
                    texts.setdefault(name, []).append(one)
                else:  # numbers in one part and text in another: what they are takes all rows
                    return parser(None)
    joined = {name: pd.concat(each, ignore_index=True) for name, each in texts.items()}
    columns: dict[Any, Any] = {**numeric, **joined}
    return pd.DataFrame({name: columns[name] for name in names}, copy=False)


def _longer(old: np.ndarray | None, more: np.ndarray) -> np.ndarray:
    """A column and its next rows; grown in place, which takes no second copy of a large one."""
    if old is None:
        return more.copy()
    whole = old.astype(np.result_type(old, more), copy=False)
    whole.resize(len(old) + len(more), refcheck=False)
    whole[-len(more) :] = more
    return whole


def _read_csv(path: Path) -> pd.DataFrame:
    try:
        with _opened(path) as file:
            text = io.TextIOWrapper(file, encoding="utf-8-sig")
            header = text.readline(_LONGEST_HEADER + 1)
            text.detach()
            separator = max(",;\t", key=header.count)
            columns = header.count(separator) + 1
            if len(header) > _LONGEST_HEADER or columns > _MOST_COLUMNS:
                raise LogError(
                    f"{path}: the first line has {columns} columns in {len(header)} letters or "
                    f"more, expected a header of at most {_MOST_COLUMNS} names: is the table "
                    "transposed?"
                )
            with warnings.catch_warnings():
                # Pandas would cut rows that are longer than the header, and only warn.
                warnings.simplefilter("error", pd.errors.ParserWarning)
                table = _parsed(file, separator)
    except (
        pd.errors.ParserError,
        pd.errors.ParserWarning,
        pd.errors.EmptyDataError,
        UnicodeDecodeError,
        OSError,  # also of gzip
        EOFError,
        zlib.error,
    ) as error:
        said = " ".join(str(error).split())
        raise LogError(
            f"{path}: cannot be read as CSV with a header line: {_cause(path) or said}"
        ) from error
    # Pandas would number columns of one name.
    names = next(csv.reader([header], delimiter=separator, skipinitialspace=True), [])
    found = names if len(names) == table.shape[1] else table.columns
    table.columns = [str(name).strip() for name in found]
    table.index = pd.RangeIndex(2, len(table) + 2)
    # Blank lines are counted, so that lines keep their numbers, but at the end they do no harm.
    ends = (table.iloc[:, k].last_valid_index() for k in range(table.shape[1]))
    filled = max((int(end) - 1 for end in ends if end is not None), default=0)
    if not filled:
        raise LogError(f"{path}: has no rows, expected a header line and rows of numbers")
    return table.iloc[:filled]


def _cause(path: Path) -> str | None:
    """What pandas does not say: a file that is no text, or lines above the header."""
    if path.suffix == ".gz":
        return None
    with path.open("rb") as file:
        start = file.read(2 * _LONGEST_HEADER)
    for magic, what in _NO_TEXT.items():
        if start.startswith(magic):
            return what
    first, *others = start.decode("utf-8", "ignore").splitlines()[:8] or [""]
    if first.lower().startswith("sep="):
        return f"line 1 is {shown(first)}, which Excel alone understands: delete it"
    counts = [max(line.count(separator) for separator in ",;\t") for line in (first, *others)]
    more = max(counts, default=0)
    if more > counts[0]:
        return (
            f"line 1 has {counts[0] + 1} columns and line {counts.index(more) + 1} has {more + 1}: "
            "is line 1 the header? Delete lines above it, and name each column"
        )
    return None


def _opened(path: Path) -> BinaryIO:
    """A file, unpacked if it is compressed.

    Raises:
        LogError: on one that holds far more than a table of numbers would.
    """
    if path.suffix != ".gz":
        return path.open("rb")
    most = most_bytes(path.stat().st_size)
    with gzip.open(path) as packed:
        content = packed.read(most + 1)
    if len(content) > most:
        raise LogError(
            f"{path}: {path.stat().st_size} compressed bytes hold more than {most}, expected a "
            "table of numbers, which no file shrinks that far: unpack it and look into it"
        )
    return io.BytesIO(content)
