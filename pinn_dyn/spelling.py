"""Suggestions for misspelled names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: object, names: Iterable[str]) -> str:
    """Return the names that resemble one, as the end of a sentence; "" without any."""
    close = difflib.get_close_matches(str(name), list(names))
    return f": did you mean {' or '.join(close)}?" if close else ""
