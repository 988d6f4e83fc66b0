"""Units of columns: a table of factors to SI."""

from __future__ import annotations

import math

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.spelling import did_you_mean

_DEGREE, _TURN = math.pi / 180, 2 * math.pi

_FACTORS: dict[str, dict[str, float]] = {
    "1": {"1": 1.0, "%": 0.01},
    "1/s": {"1/s": 1.0},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": _DEGREE, "rev": _TURN},
    "rad/s": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": _DEGREE, "rpm": _TURN / 60},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    "m/s": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "Nm": {"Nm": 1.0, "mNm": 1e-3},
    "N": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
    "A": {"A": 1.0, "mA": 1e-3},
    "V": {"V": 1.0, "mV": 1e-3},
    "Pa": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "mbar": 1e2, "bar": 1e5, "psi": 6894.757293168361},
}

UNITS: dict[str, tuple[str, float]] = {
    unit: (si, factor) for si, units in _FACTORS.items() for unit, factor in units.items()
}
"""SI unit of each unit, and the factor to it: x_SI = factor * x."""


def to_si(unit: str) -> tuple[str, float]:
    """Return the SI unit of a unit, and the factor to it."""
    if unit not in UNITS:
        hint = did_you_mean(unit, UNITS) or "."
        raise LogError(f"unit is {unit!r}{hint} Known units are {', '.join(UNITS)}")
    return UNITS[unit]
