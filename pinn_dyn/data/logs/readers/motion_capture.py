"""Convert the header rows of motion-capture files to a header and a row of units.

The files repeat the names X, Y and Z below the names of markers, rigid bodies and segments. The
converted column is ``marker:X``. Repeated names get a number, ``marker:X #2``.

- OptiTrack Motive: rows Type, Name, ID and Parent above the quantity and the axis. Rotations of
  rigid bodies are ``body:rotation X``.
- Vicon Nexus: sections such as Trajectories, each with its rate, names, axes and units. The section
  that holds the largest number of requested columns is read.
- Qualisys: ``MARKER_NAMES`` above the rows, with or without a row of column names.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Collection, Sequence

import pandas as pd

_SECTION = re.compile(r"(Devices|Events|Joints|Model Outputs|Segments|Trajectories)[,;\t ]*")
_LENGTHS = {"meters": "m", "centimeters": "cm", "millimeters": "mm"}
_AXES = ("X", "Y", "Z")


def one_header(text: str, requested: Collection[str]) -> tuple[str, float]:
    """Return a text file with a single header and the same lines; other files unchanged.

    The second result is the rate of the frames in a file of Vicon or Qualisys, Hz; otherwise 0.

    Args:
        text: the file.
        requested: columns that a data set needs.
    """
    start = text[:2000].lstrip()
    if start.startswith("Format Version"):
        return _motive(text), 0.0
    if _SECTION.fullmatch(start.partition("\n")[0]):
        return _vicon(text, requested)
    if not start.startswith("NO_OF_FRAMES"):
        return text, 0.0
    stated = re.search(r"(?m)^FREQUENCY[,;\t ]+([\d.]+)", text)
    return _qualisys(text), float(stated[1]) if stated else 0.0


def _motive(text: str) -> str:
    lines = text.split("\n")
    last = next((k for k, x in enumerate(lines) if x.startswith(("Frame,", '"Frame"'))), 0)
    rows = [_cells(line, ",") for line in lines[: last + 1]]
    named = next(x for x in rows if x[1:2] == ["Name"])
    quantities, axes = rows[last - 1], rows[last]
    length = next((unit for cell in rows[0] if (unit := _LENGTHS.get(cell.lower()))), "")
    names, units = axes[:2], ["", "s"]
    for name, quantity, axis in zip(named[2:], quantities[2:], axes[2:], strict=False):
        kind = "" if quantity == "Position" else quantity.lower()
        names.append(f"{name}:{' '.join(filter(None, [kind, axis]))}")
        units.append("" if kind else length)
    return _with_header(lines, last - 1, last + 1, names, units, ",")


def _vicon(text: str, requested: Collection[str]) -> tuple[str, float]:
    lines = text.split("\n")
    starts = [k for k, line in enumerate(lines) if _SECTION.fullmatch(line.strip())]
    best: tuple[int, int, list[str], str] = (-1, 0, [], ",")
    for start in starts:
        separator = next((x for x in "\t;," if x in "".join(lines[start + 2 : start + 4])), ",")
        owners, axes = (_cells(x, separator) for x in [*lines, "", ""][start + 2 : start + 4])
        owners += [""] * (len(axes) - len(owners))
        markers = pd.Series(owners[: len(axes)], dtype=object)
        filled = markers.where(markers != "").ffill().fillna("")
        names = [f"{x}:{axis}" if x else axis for x, axis in zip(filled, axes, strict=True)]
        matches = len({*names} & {*requested})
        if matches > best[0]:
            best = matches, start, names, separator
    _, start, names, separator = best
    end = next((k for k in starts if k > start), len(lines))
    units = _cells("".join(lines[start + 4 : start + 5]), separator)
    stated = re.match(r"[\d.]+", "".join(lines[start + 1 : start + 2]).strip())
    rate = float(stated[0]) if stated else 0.0
    return _with_header(lines[:end], start + 3, start + 5, names, units, separator), rate


def _qualisys(text: str) -> str:
    lines = text.split("\n")
    separator = "\t" if "\t" in lines[0] else ","
    rows = [_cells(line, separator) for line in lines[:60]]
    first = next((k for k, x in enumerate(rows) if re.fullmatch(r"-?\d+([.]\d*)?", x[0])), 0)
    markers = next((x[1:] for x in rows if x[0] == "MARKER_NAMES"), [])
    columns = [f"{name}:{axis}" for name in markers if name for axis in _AXES]
    if not columns or first < 2:
        return text
    extra = max(len([x for x in rows[first] if x]) - len(columns), 0)
    names = [*["Frame", "Time"][:extra], *columns]
    units = [*["", "s"][:extra], *["mm"] * len(columns)]
    return _with_header(lines, first - 2, first, names, units, separator)


def _with_header(
    lines: Sequence[str],
    header: int,
    first: int,
    names: Sequence[str],
    units: Sequence[str],
    separator: str,
) -> str:
    """Return the lines with a header and a row of units above the rows from ``first`` on."""
    counts: dict[str, int] = {}
    unique = []
    for name in names:
        counts[name] = counts.get(name, 0) + 1
        unique.append(name if counts[name] == 1 else f"{name} #{counts[name]}")
    above = [""] * header + [_joined(unique, separator), _joined(units, separator)]
    above += [""] * (first - len(above))
    return "\n".join([*above, *lines[first:]])


def _joined(cells: Sequence[str], separator: str) -> str:
    text = io.StringIO()
    csv.writer(text, delimiter=separator, lineterminator="").writerow(cells)
    return text.getvalue()


def _cells(line: str, separator: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])] or [""]
