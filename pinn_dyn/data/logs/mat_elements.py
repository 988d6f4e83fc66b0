"""The elements of a MATLAB file, checked before SciPy, which an unknown type crashes."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Literal

from pinn_dyn.data.logs.errors import most_bytes

# As the description of MAT-files of level 5 by MathWorks numbers them.
_NUMERIC = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18}
_MATRIX, _COMPRESSED = 14, 15
_OF_NUMBERS = range(4, 16)  # classes of arrays that hold no other arrays
_HEADER = 128


def check_elements(path: Path) -> None:
    """Refuse a file of level 5 in which an element is of a type that cannot stand there.

    Raises:
        ValueError: with the type.
        zlib.error: if a compressed element is damaged.
    """
    content = path.read_bytes()
    mark = content[_HEADER - 2 : _HEADER]
    order: Literal["little", "big"] = "little" if mark == b"IM" else "big"
    version = int.from_bytes(content[_HEADER - 4 : _HEADER - 2], order)
    # Others are of level 4, which has no elements, of 7.3, which is HDF5, or none at all.
    if mark in (b"IM", b"MI") and version >> 8 == 1:
        _check(memoryview(content)[_HEADER:], order, {_MATRIX, _COMPRESSED} | _NUMERIC)


def _check(data: memoryview, order: Literal["little", "big"], allowed: set[int]) -> None:
    place = 0
    while place + 8 <= len(data):
        kind = int.from_bytes(data[place : place + 4], order)
        size = int.from_bytes(data[place + 4 : place + 8], order)
        small = kind >> 16  # the size of one that fits into its tag
        kind, size = (kind & 0xFFFF, 0) if small else (kind, size)
        if kind not in allowed or (small and kind not in _NUMERIC):
            raise ValueError(f"it has an element of type {kind} where none can be, it is damaged")
        inside = data[place + 8 : place + 8 + size]
        if kind == _COMPRESSED:
            unpacked = zlib.decompressobj().decompress(inside, most_bytes(size))
            _check(memoryview(unpacked), order, {_MATRIX})
        elif kind == _MATRIX and len(inside) >= 16:
            numbers = inside[8 if order == "little" else 11] in _OF_NUMBERS
            _check(inside, order, _NUMERIC if numbers else _NUMERIC | {_MATRIX})
        place += 8 + size + (0 if kind == _COMPRESSED else -size % 8)
