"""The error of the logs, and names in its messages."""

from collections.abc import Iterable

_MOST_LETTERS, _MOST_NAMES = 80, 30


class LogError(ValueError):
    """A log or its description cannot be used; the message names the place and what to do."""


def shown(value: object) -> str:
    """Return a value for a message, shortened: an open quote makes a cell of a whole file."""
    text = repr(value)
    return text if len(text) <= _MOST_LETTERS else f"{text[:_MOST_LETTERS]}..."


def listed(names: Iterable[object]) -> str:
    """Return the first names of a list that may be long, for a message."""
    texts = [str(name) for name in names]
    more = f" and {len(texts) - _MOST_NAMES} more" if len(texts) > _MOST_NAMES else ""
    return ", ".join(texts[:_MOST_NAMES]) + more
