"""Suggestions for misspelled names."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable


def did_you_mean(name: object, names: Iterable[str]) -> str:
    """Return the names that resemble one, as the end of a sentence; "" without any.

    Names that differ in case, blanks, quotes or a unit in brackets alone come first.
    """
    names, plain = list(names), _plain(name)
    equal = [x for x in names if plain and _plain(x) == plain]
    close = equal or difflib.get_close_matches(str(name), names)
    return f": did you mean {' or '.join(close)}?" if close else ""


def _plain(name: object) -> str:
    return re.sub(r"[\[(]\D*[\])]|[\s\"'_]", "", str(name)).lower()
