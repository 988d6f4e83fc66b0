"""Read text files of numbers; detect encoding, separator, decimal mark, header and units.

Separator and decimal mark are the pair with the largest count of numbers in the rows. The header is
the line above the numbers with the largest count of requested columns. Columns of a file without a
header are ``0``, ``1``, ``2`` and so on.
"""

from __future__ import annotations

import csv
import gzip
import io
import itertools
import re
import warnings
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from pinn_dyn.data.logs.columns import known_unit
from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.readers.motion_capture import one_header
from pinn_dyn.data.logs.table import Request, Table, vector_columns

_SAMPLE = 300  # number of lines for the detection of the dialect and the header
_BLOCK = 1 << 24  # number of bytes that are parsed at once
_FOOTER = 20  # largest number of lines after the last row
_COMMENTS = ("#", "%", "//")
_NO_VALUES = ["-", "--", "nan(ind)", "-nan(ind)"]  # in addition to those of pandas
_MISSING = {"", "nan", "na", "n/a", "null", "none", *_NO_VALUES}
_NUMBERS = {
    mark: rf"[+-]?(?:\d+[{mark}]?\d*|[{mark}]\d+)(?:[eE][+-]?\d+)?|[+-]?inf|true|false"
    for mark in ".,"
}
_NUMBER = {mark: re.compile(text, re.ASCII | re.IGNORECASE) for mark, text in _NUMBERS.items()}
_FRAME, _TIME = "Frame", "Time"  # columns of motion capture
_ITEM = rf"(?:{_NUMBERS['.']}|nan)"
_BRACKETS = rf"[\[({{]\s*{_ITEM}(?:[\s,;]+{_ITEM})*[\s,;]*[\])}}]"
_BARE_BRACKETS = re.compile(rf"(?<![^\s,;]){_BRACKETS}", re.IGNORECASE)
_VECTOR = re.compile(rf"(?:array\()?{_BRACKETS}\)?", re.ASCII | re.IGNORECASE)


class _Dialect(NamedTuple):
    separator: str
    decimal: str
    width: int

    def cells(self, line: str, separator: str = "") -> list[str]:
        """Return the cells of a line. Several blanks count as a single separator ``" "``."""
        separator = separator or self.separator
        if separator == " ":
            line = re.sub(r"[ \t]+", " ", line.strip(" \t"))
        row = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
        return [cell.strip() for cell in row]

    def numeric(self, line: str) -> list[bool | None]:
        """Return true for each cell of a line with a number or a vector, None for empty cells."""
        number = _NUMBER[self.decimal]

        def kind(cell: str) -> bool | None:
            if cell.lower() in _MISSING:
                return None
            return bool(number.fullmatch(cell) or _VECTOR.fullmatch(cell))

        return list(map(kind, self.cells(line)))


def read_text(path: Path, request: Request) -> Table:
    """Read a text file of numbers.

    Args:
        path: the file; UTF-8, UTF-16 with a byte order mark, or Windows-1252.
        request: requested columns, which identify the header, and the separator if known.

    Raises:
        LogError: if no line contains numbers, or rows are longer than the header.
    """
    blocks = _blocks(path)
    text, rate = one_header(next(blocks, ""), request.columns)
    if rate or text.startswith("\n"):  # converting a header of motion capture changes the lines
        text, rate = one_header("".join([*_blocks(path)]), request.columns)
        blocks = iter(())
    brackets = bool(_BARE_BRACKETS.search(text, 0, 10_000))
    text = _BARE_BRACKETS.sub(r'"\g<0>"', text) if brackets else text
    lines = text.split("\n", _SAMPLE)[:_SAMPLE]
    dialect = _dialect(lines, request.sep)
    if dialect is None:
        line = next(filter(None, map(str.strip, reversed(lines))), "")[:80]
        text = f"has no rows of numbers in its first {_SAMPLE} lines"
        raise LogError(f"{path}: {text}: expected numbers such as 1234.5, but found {line!r}")
    names, header, start = _header(lines, dialect, request.columns)
    if len(names) < dialect.width:
        raise LogError(
            f"{path}, line {start + 1}: {dialect.width} cells, but the header in line {header + 1} "
            f"has {len(names)} names: {listed(names)}"
        )
    body = _Body(dialect, names, lines[header] if header >= 0 else "", start)
    following = next(blocks, "")
    body.add(text[sum(len(line) + 1 for line in lines[:start]) :], last=not following)
    while following:
        text, following = following, next(blocks, "")
        body.add(_BARE_BRACKETS.sub(r'"\g<0>"', text) if brackets else text, last=not following)
    frame, notes = body.rows()
    frame = _with_vectors(frame, names)
    if rate and _FRAME in frame:
        frame, notes = _of_frames(frame, rate, notes)
    units = _units(lines[header + 1 : start], dialect, names)
    hint = "" if header >= 0 else ": the file has no header, so columns are numbered from 0."
    return Table(frame, str(path), "line", notes, units, hint)


def _blocks(path: Path) -> Iterator[str]:
    """Yield the text of a file in blocks of whole lines, to save memory."""
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        content = file.read(_BLOCK)
        if _is_utf16(content):
            yield _decoded(content + file.read())  # a line break has no unique byte
            return
        while content:
            block = file.read(_BLOCK)
            end = content.rfind(b"\n") + 1 if block else len(content)
            if end:
                yield _decoded(content[:end])
            content = content[end:] + block


class _Body:
    """Rows of a text file, parsed in blocks. Only the numbers of a block are stored."""

    def __init__(self, dialect: _Dialect, names: Sequence[str], header: str, start: int):
        self._dialect, self._width, self._header = dialect, len(names), header
        self._lines = start
        self._parts: list[dict[int, np.ndarray]] = []
        self._rows: list[np.ndarray] = []
        self._repeats = 0
        self._notes: list[str] = []

    def add(self, text: str, *, last: bool) -> None:
        """Parse a block of lines."""
        first = self._lines
        if any(mark in text for mark in _COMMENTS):
            text = re.sub(rf"(?m)^[ \t]*(?:{'|'.join(_COMMENTS)}).*$", "", text)
        if self._header:
            repeats = f"\n{self._header}\n"
            text = f"\n{text}"
            self._repeats += text.count(repeats)
            text = text.replace(repeats, "\n\n")[1:]
        if last:
            text = self._without_end(text.rstrip("\n\0 "), first)
        self._lines += text.count("\n")
        try:
            frame = self._parsed(text, first if not self._parts else 0)
        except (pd.errors.ParserError, pd.errors.ParserWarning):
            frame = self._parsed(text, first)  # now the message has the line number in the file
        frame.index = pd.RangeIndex(first + 1, len(frame) + first + 1)
        frame = frame.dropna(how="all")
        self._rows.append(frame.index.to_numpy())
        self._parts.append({k: frame[k].to_numpy() for k in frame})

    def _parsed(self, text: str, above: int) -> pd.DataFrame:
        """Parse lines below ``above`` empty lines, which keep the line numbers in messages."""
        separator = self._dialect.separator
        with warnings.catch_warnings():
            # By default, pandas cuts rows that are longer than the header, and only warns.
            warnings.simplefilter("error", pd.errors.ParserWarning)
            return pd.read_csv(
                io.BytesIO(("\n" * above + text).encode()),
                skiprows=above,
                sep=r"\s+" if separator == " " else separator,
                decimal=self._dialect.decimal,
                header=None,
                names=range(self._width),
                na_values=_NO_VALUES,
                skipinitialspace=True,
                skip_blank_lines=False,
                low_memory=False,
                index_col=False,
            )

    def rows(self) -> tuple[pd.DataFrame, list[str]]:
        """Return all rows, and notes on repairs of the file.

        Parsed blocks are released, so that each column is stored once.
        """
        if self._repeats:
            text = (
                f"{self._repeats} lines that repeat the header are dropped: a restarted recorder?"
            )
            self._notes.insert(0, text)
        columns = {
            k: np.concatenate([part.pop(k) for part in self._parts]) for k in range(self._width)
        }
        index = pd.Index(np.concatenate(self._rows))
        return pd.DataFrame(columns, index=index, copy=False), self._notes

    def _without_end(self, text: str, before: int) -> str:
        """Return the lines without incomplete lines at the end."""
        end = text.rsplit("\n", _FOOTER)
        widths = [len(self._dialect.cells(line)) for line in end[:0:-1]]
        short = next((k for k, width in enumerate(widths) if width >= self._dialect.width), 0)
        if not short:
            return text
        text = "\n".join(end[:-short])
        first = before + text.count("\n") + 2
        self._notes.append(
            f"{short} lines from line {first} on are dropped, since they are shorter than the "
            f"rows, such as {end[-1][:80]!r}"
        )
        return text


def _of_frames(
    frame: pd.DataFrame, rate: float, notes: list[str]
) -> tuple[pd.DataFrame, list[str]]:
    """Return the rows with times from the frame numbers, and notes on missing frames."""
    numbers = frame[_FRAME].to_numpy(float)
    missing = np.flatnonzero(np.diff(numbers) > 1)
    if len(missing):
        count = int((np.diff(numbers)[missing] - 1).sum())
        text = f"{count} frames are missing, the first after frame {numbers[missing[0]]:g}"
        notes = [*notes, f"{text}: time: {{columns: {_TIME}}} counts frames, not rows"]
    if _TIME not in frame:
        frame = frame.assign(**{_TIME: (numbers - numbers[0]) / rate})
    return frame, notes


def _is_utf16(content: bytes) -> bool:
    return content[:2] in (b"\xff\xfe", b"\xfe\xff") or content[1:2] == b"\0"


def _decoded(content: bytes) -> str:
    if _is_utf16(content):
        text = content.decode("utf-16")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("cp1252")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _dialect(lines: Sequence[str], separator: str | None) -> _Dialect | None:
    """Return the dialect with the largest count of numbers in rows of equal width."""
    scores: Counter[_Dialect] = Counter()
    for decimal in ".,":
        for mark in [separator] if separator else ",;\t| ":
            dialect = _Dialect(mark, decimal, 0)
            for line in lines[-100:] if mark != decimal else ():
                filled = [cell for cell in dialect.numeric(line) if cell is not None]
                if any(filled):
                    width = len(dialect.cells(line))
                    scores[dialect._replace(width=width)] += sum(filled) ** 2 / len(filled)  # type: ignore[assignment]
    if not scores:
        return None
    best = max(scores, key=lambda dialect: scores[dialect])
    rows = [row for row in map(best.cells, lines) if len(row) == best.width]
    columns = [k for k, column in enumerate(zip(*rows, strict=True)) if any(column)]
    return best._replace(width=columns[-1] + 1)  # rows may end in a separator


def _header(
    lines: Sequence[str], dialect: _Dialect, requested: Collection[str]
) -> tuple[list[str], int, int]:
    """Return the names of the columns, the line of the header (or -1), and the first row."""
    rows = [dialect.numeric(line)[: dialect.width] for line in lines]
    full = [row for row in rows if len(row) == dialect.width]
    columns = [k for k, x in enumerate(zip(*full, strict=True)) if 2 * x.count(False) < len(x)]

    def is_row(k: int) -> bool:
        cells = [rows[k][n] for n in columns if n < len(rows[k])]
        if len(cells) < len(columns) or not any(cells) or False in cells:
            return False
        matches = {*dialect.cells(lines[k])} & {*requested}  # a header may consist of numbers
        return len(matches) < 2 or all(name.isdigit() for name in matches)

    first = next((k for k in range(len(rows)) if is_row(k)), len(rows))
    names = [str(k) for k in range(dialect.width)]
    best = (len({*names} & {*requested}), False, False, False, -1)
    for k, line in enumerate(lines[:first]):
        texts = [line, line.lstrip(" \t#%/")] if _comment(line) else [line]
        for candidate in itertools.chain.from_iterable(_names(text, dialect) for text in texts):
            matches = len({*candidate} & {*requested})
            exact = len(candidate) == dialect.width
            is_units = not any(known_unit(cell) is None for cell in candidate if cell)
            score = (matches, exact, not is_units, not _comment(line), k)
            if (exact or matches) and score > best:
                best, names = score, candidate
    header = best[-1]
    names[0] = names[0] or "index"
    numbers = dialect.cells("".join(lines[first : first + 1]))
    if header < 0 and dialect.width > 1 and numbers == names:
        header, first = first, first + 1  # the first row is a header of numbers by pandas
    return names, header, first


def _comment(line: str) -> bool:
    return line.lstrip().startswith(_COMMENTS)


def _names(line: str, dialect: _Dialect) -> list[list[str]]:
    """Return the possible names in a header line, for each possible separator."""
    cells = re.findall(r'"[^"]*"|[^\s\[(]+(?:[ \t]*[\[(][^\])]*[\])])?', line)
    splits = [dialect.cells(line, mark) for mark in (dialect.separator, *",;\t|") if mark != " "]
    splits.append([word.strip('"') for word in cells])
    for names in splits:
        while names and not names[-1]:
            names.pop()
    return splits


def _units(lines: Sequence[str], dialect: _Dialect, names: Sequence[str]) -> dict[str, str]:
    """Return the units of columns from names such as ``q [deg]``, or lines below the header."""
    matches = {name: re.search(r"[\[(](\D*)[\])]$", name) for name in names}
    units = {name: match[1] for name, match in matches.items() if match}
    for line in lines:
        units |= dict(zip(names, dialect.cells(line.strip().lstrip("#%/ ")), strict=False))
    return units


def _with_vectors(frame: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Name the columns. A column of vectors becomes ``name_1``, ``name_2`` and so on."""
    columns: dict[int, pd.Series] = {}
    labels: list[str] = []
    for name, (_, column) in zip(names, frame.items(), strict=True):
        part = {name: column}
        if not pd.api.types.is_numeric_dtype(column):
            cells = column.dropna().astype(str).str.strip()
            if len(cells) and cells.map(_VECTOR.fullmatch).notna().all():
                vectors = cells.str.strip("aryARY[](){} ,;").str.split(r"[\s,;]+")
                part = vector_columns(name, vectors.reindex(column.index))
        for label, values in part.items():
            columns[len(labels)] = values
            labels.append(label)
    table = pd.DataFrame(columns, index=frame.index, copy=False)
    return table.set_axis(labels, axis=1)
