"""Lengths of steps and windows in samples or as a time: 5, or "20 ms"."""

from __future__ import annotations

import re

Length = int | str
"""Number of samples, or a time with a unit. A time does not depend on the sample rate."""

_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0}


def seconds_of(name: str, length: str, alternatives: str = "") -> float:
    """Convert a length such as ``"20 ms"`` to s.

    Args:
        name: name of the setting, for the error message.
        length: the length.
        alternatives: additional allowed values, for the error message.

    Raises:
        ValueError: if the text is not a positive time with a unit.
    """
    units = "|".join(_SECONDS)
    match = re.fullmatch(rf"\s*(\d+\.?\d*(?:e-?\d+)?|\.\d+)\s*({units})\s*", length)
    if match is None or not float(match[1]) > 0:
        expected = f"{alternatives}samples, such as 5, or a time, such as '20 ms'"
        raise ValueError(f"{name} is {length!r}, expected {expected}")
    return float(match[1]) * _SECONDS[match[2]]
