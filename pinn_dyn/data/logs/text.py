"""Text files of numbers: encoding, separator, decimal mark, header and units are detected.

The separator and the decimal mark are the pair with which the rows hold the largest number of
numbers. The header is the line above the numbers that names the largest number of requested
columns. Columns of a file without a header are ``0``, ``1``, ``2`` and so on.
"""

from __future__ import annotations

import csv
import gzip
import io
import re
import warnings
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from pinn_dyn.data.logs.columns import known_unit
from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.table import Request, Table, vector_columns

_SAMPLE = 300  # lines from which the dialect and the header are detected
_COMMENTS = ("#", "%", "//")
_NO_VALUES = ["-", "--", "nan(ind)", "-nan(ind)"]  # beside those of pandas
_MISSING = {"", "nan", "na", "n/a", "null", "none", *_NO_VALUES}
_NUMBERS = {
    mark: rf"[+-]?(?:\d+[{mark}]?\d*|[{mark}]\d+)(?:[eE][+-]?\d+)?|[+-]?inf|true|false"
    for mark in ".,"
}
_NUMBER = {mark: re.compile(text, re.ASCII | re.IGNORECASE) for mark, text in _NUMBERS.items()}
_ITEM = rf"(?:{_NUMBERS['.']}|nan)"
_BRACKETS = rf"[\[({{]\s*{_ITEM}(?:[\s,;]+{_ITEM})*[\s,;]*[\])}}]"
_SERIAL = re.compile(r"^(?:\[(\d[^]\n]*)\]|(\d+:[\d:.]+) ->) ([^,;\s]*)([,;\t ])", re.MULTILINE)
_LABEL = re.compile(r"(?<![^\s,;])([^\W\d]\w*):[ \t]*(?=[+-]?[.\d])")
_LABELED = re.compile(rf'("[^"]*"[\t,; ])?(?:{_LABEL.pattern}[^\s,;]+[ \t,;]*)+')
_BARE_BRACKETS = re.compile(rf"(?<![^\s,;]){_BRACKETS}", re.IGNORECASE)
_VECTOR = re.compile(
    rf"(?:array\()?{_BRACKETS}\)?|{_ITEM}(?:[\s;]+{_ITEM})+", re.ASCII | re.IGNORECASE
)


class _Dialect(NamedTuple):
    separator: str
    decimal: str
    width: int

    def cells(self, line: str, separator: str = "") -> list[str]:
        """Return the cells of a line; one or several blanks are the separator ``" "``."""
        separator = separator or self.separator
        if separator == " ":
            line = re.sub(r"[ \t]+", " ", line.strip(" \t"))
        row = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
        return [cell.strip() for cell in row]

    def weights(self, line: str) -> list[float | None]:
        """Return 1 for a number, 1/2 for a bare vector, 0 for text, None for an empty cell."""
        return [self._weight(cell) for cell in self.cells(line)]

    def _weight(self, cell: str) -> float | None:
        if cell.lower() in _MISSING:
            return None
        if _NUMBER[self.decimal].fullmatch(cell):
            return 1.0
        return (0.5 if cell[0] in "+-.0123456789" else 1.0) if _VECTOR.fullmatch(cell) else 0.0


def read_text(path: Path, request: Request) -> Table:
    """Read a text file of numbers.

    Args:
        path: the file; UTF-8, UTF-16 with a byte order mark, or Windows-1252.
        request: columns that tell the header from text above it, and the separator if it is known.

    Raises:
        LogError: if no line holds numbers, or rows are longer than the header.
    """
    content = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
    return parse_text(_decoded(content), path, request)


def read_excel(path: Path, request: Request) -> Table:
    """Read the first sheet of a spreadsheet as a text file."""
    try:
        sheet = pd.read_excel(path, header=None)
    except ImportError as error:
        raise LogError(f"{path}: save the sheet as CSV. {error}") from error
    return parse_text(sheet.to_csv(header=False, index=False), path, request)


def _decoded(content: bytes) -> str:
    if content[:2] in (b"\xff\xfe", b"\xfe\xff") or content[1:2] == b"\0":
        return content.decode("utf-16")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252")


def parse_text(text: str, path: Path, request: Request) -> Table:
    """Return the table of a text, see :func:`read_text`."""
    text = text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text
    if _BARE_BRACKETS.search(text, 0, 10_000):
        text = _BARE_BRACKETS.sub(r'"\g<0>"', text)
    if _SERIAL.search(text, 0, 10_000):  # stamps of a terminal
        text = _SERIAL.sub(r'"\1\2"\4\3\4', text)
    lines = text.split("\n", _SAMPLE)[:_SAMPLE]
    if labels := _LABELED.fullmatch(lines[len(lines) // 2]):  # serial plotter of Arduino
        names = ([""] if labels[1] else []) + _LABEL.findall(labels[0])
        text = ",".join(names) + "\n" + _LABEL.sub("", text)
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
    # The lines above are empty, as quotes in them may be unbalanced.
    body = "\n" * start + text[sum(len(line) + 1 for line in lines[:start]) :]
    body, notes = _repaired(body, lines[:start], dialect)
    with warnings.catch_warnings():
        # pandas would cut rows that are longer than the header, and only warn.
        warnings.simplefilter("error", pd.errors.ParserWarning)
        frame = pd.read_csv(
            io.BytesIO(body.encode()),
            skiprows=start,
            sep=r"\s+" if dialect.separator == " " else dialect.separator,
            decimal=dialect.decimal,
            header=None,
            names=range(len(names)),
            na_values=_NO_VALUES,
            skipinitialspace=True,
            skip_blank_lines=False,
            low_memory=False,
            index_col=False,
        )
    frame.index = pd.RangeIndex(len(frame)) + (start if labels else start + 1)
    bare = [re.sub(r"\s*[\[(][^\])]*[\])]$", "", name) for name in names]
    short = [
        x if x in {*request.columns} - {*names} and bare.count(x) == 1 else name
        for x, name in zip(bare, names, strict=True)
    ]
    frame = _with_vectors(frame.dropna(how="all"), short)
    units = _units(lines[header + 1 : start], dialect, names)
    units |= {x: units[name] for x, name in zip(short, names, strict=True) if name in units}
    hint = "" if header >= 0 else ": it has no header, so its columns are numbered from 0."
    return Table(frame, str(path), "line", notes, units, hint)


def _dialect(lines: Sequence[str], separator: str | None) -> _Dialect | None:
    """Return the dialect with which rows of equal width hold the largest number of numbers."""
    scores: Counter[_Dialect] = Counter()
    for decimal in ".,":
        for mark in [separator] if separator else ",;\t| ":
            dialect = _Dialect(mark, decimal, 0)
            for line in lines[-100:] if mark != decimal else ():
                weights = dialect.weights(line)
                filled = [weight for weight in weights if weight is not None]
                if any(filled):
                    score = sum(filled) ** 2 / len(filled)
                    scores[dialect._replace(width=len(weights))] += score  # type: ignore[assignment]
    if not scores:
        return None
    best = max(scores, key=lambda dialect: scores[dialect])
    rows = [cells for line in lines if len(cells := best.cells(line)) == best.width]
    filled_columns = [k for k in range(best.width) if any(row[k] for row in rows)]
    return best._replace(width=filled_columns[-1] + 1)  # rows may end in a separator


def _header(
    lines: Sequence[str], dialect: _Dialect, requested: Collection[str]
) -> tuple[list[str], int, int]:
    """Return the names of the columns, the line of the header or -1, and the first row."""
    rows = [dialect.weights(line)[: dialect.width] for line in lines]
    columns = list(zip(*(row for row in rows if len(row) == dialect.width), strict=True))
    numeric = [k for k, cells in enumerate(columns) if _texts(cells) < len(cells) / 2]

    def is_row(k: int) -> bool:
        cells = [rows[k][n] for n in numeric if n < len(rows[k])]
        if len(cells) < len(numeric) or not any(cells) or _texts(cells):
            return False
        matches = {*dialect.cells(lines[k])} & {*requested}  # names of columns may be numbers
        return len(matches) < 2 or all(name.isdigit() for name in matches)

    def is_text(k: int) -> bool:
        units = [known_unit(cell) for cell in dialect.cells(lines[k]) if cell]
        numbers = [weight for weight in rows[k] if weight]
        texts = _texts([rows[k][n] for n in numeric if n < len(rows[k])])
        is_units = None not in units and len(numbers) < len(units)
        return not numbers or is_units or texts >= max(2, len(numeric) / 2) or _comment(lines[k])

    first = next((k for k in range(len(rows)) if is_row(k)), len(rows))
    best = (len({str(k) for k in range(dialect.width)} & {*requested}), False, False, False, -1)
    names = [str(k) for k in range(dialect.width)]
    for k, line in enumerate(lines[:first]):
        bare = [line.lstrip(" \t#%/")] if _comment(line) else []
        for candidate in [names for text in (line, *bare) for names in _names(text, dialect)]:
            if len(set(candidate)) < len(candidate) and k:
                candidate = _grouped(dialect.cells(lines[k - 1]), candidate)
            matches = len({*candidate} & {*requested})
            exact = len(candidate) == dialect.width
            is_units = not any(known_unit(cell) is None for cell in candidate if cell)
            score = (matches, exact, not is_units, not _comment(line), k)
            if (exact or matches) and score > best:
                best, names = score, candidate
    header = best[-1]
    for line in lines[:first]:  # names of the index, which pandas writes in a line of their own
        for k, cell in enumerate(dialect.cells(line)[: len(names)]):
            if not names[k] and cell in {*requested} - {*names}:
                names[k] = cell
    names[0] = names[0] or "index"
    if header < 0 and dialect.cells("".join(lines[first : first + 1])) == names:
        header = first  # pandas numbers columns without names
    start = next((k for k in range(header + 1, len(rows)) if not is_text(k)), len(rows))
    return names, header, first if header < 0 else start


def _texts(weights: Collection[float | None]) -> int:
    return sum(weight == 0 for weight in weights)


def _comment(line: str) -> bool:
    return line.lstrip().startswith(_COMMENTS)


def _names(line: str, dialect: _Dialect) -> list[list[str]]:
    """Return the names that a header would hold, by the separators that it may have."""
    cells = re.findall(r'"[^"]*"|[^\s\[(]+(?:[ \t]*[\[(][^\])]*[\])])?', line)
    splits = [dialect.cells(line, mark) for mark in (dialect.separator, *",;\t|") if mark != " "]
    splits.append([word.strip('"') for word in cells])
    for names in splits:
        while names and not names[-1]:
            names.pop()
    if dialect.separator == " " and len(splits[-1]) == dialect.width - 1:
        splits[-1].insert(0, "")  # R leaves the names of the rows without a header
    return splits


def _grouped(groups: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return repeated names behind the names of their groups in the line above."""
    result, group = [], ""
    for k, name in enumerate(names):
        group = groups[k] if k < len(groups) and groups[k] else group
        result.append(f"{group} {name}".strip() if list(names).count(name) > 1 else name)
    return result


def _units(lines: Sequence[str], dialect: _Dialect, names: Sequence[str]) -> dict[str, str]:
    """Return the units of columns in their names, ``q [deg]``, or in a line below the header."""
    units = {name: match[1] for name in names if (match := re.search(r"[\[(](\D*)[\])]$", name))}
    for line in lines:
        units |= dict(zip(names, dialect.cells(line.strip().lstrip("#%/ ")), strict=False))
    return units


def _repaired(body: str, above: Sequence[str], dialect: _Dialect) -> tuple[str, list[str]]:
    """Return the rows without comments, repeated headers and a last line cut short, with notes."""
    notes = []
    if any(mark in body for mark in _COMMENTS):
        body = re.sub(rf"(?m)^[ \t]*(?:{'|'.join(_COMMENTS)}).*$", "", body)
    repeats = 0
    for line in filter(str.strip, dict.fromkeys(above)):
        if repeat := body.count(f"\n{line}\n"):
            repeats += repeat
            body = body.replace(f"\n{line}\n", "\n\n")
    if repeats:
        notes.append(f"{repeats} lines that repeat the header are dropped: a restarted recorder?")
    body = body.rstrip("\n\0 ")
    end = body[-100_000:].split("\n")
    cut = len(end)
    while cut > 1 and len(weights := dialect.weights(end[cut - 1])) < dialect.width:
        if cut < len(end) and any(weights):
            break
        cut -= 1
    if end[cut:]:
        body = body[: len(body) - len("\n".join(end[cut:]))]
        notes.append(f"line {body.count(chr(10)) + 1} is dropped, it is cut short: {end[cut][:80]}")
    return body, notes


def _with_vectors(frame: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Name the columns; a column of vectors becomes ``name_1``, ``name_2`` and so on."""
    frames = []
    for name, (_, column) in zip(names, frame.items(), strict=True):
        part = {name: column}
        if not pd.api.types.is_numeric_dtype(column):
            cells = column.dropna().astype(str).str.strip()
            if len(cells) and cells.map(_VECTOR.fullmatch).notna().all():
                vectors = cells.str.strip("aryARY[](){} ,;").str.split(r"[\s,;]+")
                part = vector_columns(name, vectors.reindex(column.index))
        frames.append(pd.DataFrame(part))
    return pd.concat(frames, axis=1)
