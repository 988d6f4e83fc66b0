"""The error of the logs, and names in its messages."""

from collections.abc import Iterable

_MOST_NAMES = 30
TRAJECTORY = "'trajectory' (run=... of pinn_dyn.fit)"
"""Name of the setting for the column of runs, for messages."""


class LogError(ValueError):
    """A log or its description is not usable. The message names the place and the remedy."""


def listed(names: Iterable[object]) -> str:
    """Return the first names of a list, which may be long, for a message."""
    texts = [str(name) for name in names]
    more = f" and {len(texts) - _MOST_NAMES} more" if len(texts) > _MOST_NAMES else ""
    return ", ".join(texts[:_MOST_NAMES]) + more
