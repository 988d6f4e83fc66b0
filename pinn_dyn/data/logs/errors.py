"""The one error of the logs."""

from collections.abc import Iterable


class LogError(ValueError):
    """A log or its description cannot be used; the message names the place and what to do."""


_MOST_LETTERS, _MOST_NAMES = 80, 30
_SMALL = 100_000_000
_MOST_EXPANSION = 50  # numbers of a robot compress to a tenth or so


def shown(value: object) -> str:
    """A value in a message: an open quote makes a cell of a whole file."""
    text = repr(value)
    return text if len(text) <= _MOST_LETTERS else f"{text[:_MOST_LETTERS]}..."


def listed(names: Iterable[object]) -> str:
    """Names in a message, of a file that may have thousands."""
    every = [" ".join(str(name).split()) for name in names]
    cut = [name if len(name) <= _MOST_LETTERS else f"{name[:_MOST_LETTERS]}..." for name in every]
    more = f" and {len(every) - _MOST_NAMES} more" if len(every) > _MOST_NAMES else ""
    return ", ".join(cut[:_MOST_NAMES]) + more


def most_bytes(stored: int) -> int:
    """How many bytes may come out of so many compressed ones: what gives more is no log."""
    return max(_SMALL, _MOST_EXPANSION * stored)
