"""Units of columns: a table of factors to SI."""

from __future__ import annotations

import math

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.spelling import did_you_mean

_DEGREE = math.pi / 180

UNITS: dict[str, tuple[str, float]] = {
    "1": ("1", 1.0),
    "%": ("1", 0.01),
    "1/s": ("1/s", 1.0),
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
    "min": ("s", 60.0),
    "rad": ("rad", 1.0),
    "mrad": ("rad", 1e-3),
    "deg": ("rad", _DEGREE),
    "rev": ("rad", 2 * math.pi),
    "rad/s": ("rad/s", 1.0),
    "mrad/s": ("rad/s", 1e-3),
    "deg/s": ("rad/s", _DEGREE),
    "rpm": ("rad/s", 2 * math.pi / 60),
    "m": ("m", 1.0),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    "um": ("m", 1e-6),
    "m/s": ("m/s", 1.0),
    "cm/s": ("m/s", 1e-2),
    "mm/s": ("m/s", 1e-3),
    "Nm": ("Nm", 1.0),
    "mNm": ("Nm", 1e-3),
    "N": ("N", 1.0),
    "mN": ("N", 1e-3),
    "kN": ("N", 1e3),
    "A": ("A", 1.0),
    "mA": ("A", 1e-3),
    "V": ("V", 1.0),
    "mV": ("V", 1e-3),
    "Pa": ("Pa", 1.0),
    "kPa": ("Pa", 1e3),
    "MPa": ("Pa", 1e6),
    "mbar": ("Pa", 1e2),
    "bar": ("Pa", 1e5),
    "psi": ("Pa", 6894.757293168361),
}
"""SI unit of each unit, and the factor to it: x_SI = factor * x."""


def to_si(unit: str) -> tuple[str, float]:
    """Return the SI unit of a unit, and the factor to it.

    Raises:
        LogError: on an unknown unit; lists the known units.
    """
    if unit not in UNITS:
        hint = did_you_mean(unit, UNITS) or "."
        raise LogError(f"unit is {unit!r}{hint} Known units are {', '.join(UNITS)}")
    return UNITS[unit]
