"""What a misspelt name probably meant; outside the rooms, as all of them have names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """The known names that are like another one, as the end of a sentence; "" without any."""
    close = difflib.get_close_matches(str(name), list(known))
    return f": did you mean {' or '.join(close)}?" if close else ""
