"""Nested configurations as flat tables of settings."""

from __future__ import annotations

Cell = str | int | float | bool


def flatten(config: dict, prefix: str = "") -> dict[str, Cell]:
    """Return nested sections as dotted keys.

    A class path (``_target_``) becomes the name of the class, a list its text, None ``null``.
    """
    flat: dict[str, Cell] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            flat |= flatten(value, f"{name}.")
        elif value is None:
            flat[name] = "null"
        elif key == "_target_":
            flat[name] = str(value).rsplit(".", 1)[-1]
        else:
            flat[name] = value if isinstance(value, (bool, int, float, str)) else str(value)
    return flat
