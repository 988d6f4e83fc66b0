"""Columns of a signal, and the conversion of their numbers to SI units."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import AllowInfNan, BeforeValidator, ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.wording import did_you_mean

_DEGREE, _TURN = math.pi / 180, 2 * math.pi

_FACTORS: dict[str, dict[str, float]] = {
    "1": {"1": 1.0, "%": 0.01},
    "1/s": {"1/s": 1.0},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": _DEGREE, "rev": _TURN},
    "rad/s": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": _DEGREE, "rev/s": _TURN, "rpm": _TURN / 60},
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
"""SI unit of each unit, and the factor of the conversion: x_SI = factor * x."""


_SPELLINGS = {
    **dict.fromkeys(("°", "º", "degree", "degrees"), "deg"),
    **dict.fromkeys(("sec", "second", "seconds"), "s"),
    **dict.fromkeys(("radian", "radians"), "rad"),
    **dict.fromkeys(("turn", "turns", "revolution", "revolutions"), "rev"),
    "rps": "rev/s",
    **{"µs": "us", "μs": "us", "µm": "um", "μm": "um", "-": "1"},
}
"""Names of the parts of units, by their spellings in files."""


def known_unit(text: str) -> str | None:
    """Return the name of a unit from its spelling in a file, such as ``[°/sec]``, or None."""
    parts = re.sub(r"[][(){}\s·*⋅.]|(?<=N)-", "", text).split("/")
    unit = "/".join(_SPELLINGS.get(part.lower(), part) for part in parts)
    return unit if unit in UNITS else None


def to_si(unit: str) -> tuple[str, float]:
    """Return the SI unit of a unit, and the factor of the conversion."""
    name = known_unit(unit)
    if name is None:
        hint = did_you_mean(unit, UNITS) or "."
        raise LogError(f"unit is {unit!r}{hint} Known units are {', '.join(UNITS)}")
    return UNITS[name]


STRICT = ConfigDict(extra="forbid", arbitrary_types_allowed=True)
Finite = Annotated[float, AllowInfNan(False)]
_Kind = TypeVar("_Kind")


def validated(kind: type[_Kind], name: str, value: _Kind | Mapping[str, Any]) -> Any:
    """Return an object of a class; build it from a mapping of its arguments if necessary.

    Raises:
        LogError: if an argument is missing, unknown or wrong. The message lists all mistakes.
    """
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        mistakes = [f"{'.'.join(map(str, [name, *x['loc']]))}: {x['msg']}" for x in error.errors()]
        raise LogError("; ".join(mistakes).replace("Value error, ", "")) from error


def _differences(names: Sequence[str]) -> list[str]:
    """Return names without their common prefix and suffix."""
    first = len(os.path.commonprefix(names))  # noqa: RUF071
    end = len(os.path.commonprefix([x[first:][::-1] for x in names]))  # noqa: RUF071
    return [x[first : len(x) - end] for x in names]


PerColumn = BeforeValidator(lambda x: [x] if isinstance(x, (str, int, float)) else x)


@dataclass(config=STRICT)
class Columns:
    """The columns of one signal.

        x = sign * scale * factor(unit) * (raw - offset)

    Each argument except ``columns`` is a single value, or one value per column.

    Args:
        columns: names of the columns in the file.
        unit: unit in the file, see :data:`~pinn_dyn.data.logs.UNITS`.
        sign: 1 or -1.
        scale: additional factor, such as a gear ratio.
        offset: value at x = 0, in the unit of the file.
    """

    columns: Annotated[list[str], PerColumn]
    unit: Annotated[list[str], PerColumn]
    sign: Annotated[list[Literal[1, -1]], PerColumn] = field(default_factory=lambda: [1])
    scale: Annotated[list[Finite], PerColumn] = field(default_factory=lambda: [1.0])
    offset: Annotated[list[Finite], PerColumn] = field(default_factory=lambda: [0.0])

    def __post_init__(self) -> None:
        size = len(self.columns)
        for key in ("unit", "sign", "scale", "offset"):
            values = getattr(self, key)
            if len(values) not in (1, size):
                raise LogError(f"{key} has {len(values)} entries, expected one, or {size}")
            setattr(self, key, values * size if len(values) == 1 else values)
        units = [to_si(name) for name in self.unit]
        self.units = [name for name, _ in units]
        """SI unit of each column."""
        self.factors = np.array(self.sign) * self.scale * [factor for _, factor in units]

    @property
    def labels(self) -> list[str]:
        """Name and SI unit of each column, such as ``q1 [rad]``."""
        return [
            name if unit == "1" else f"{name} [{unit}]"
            for name, unit in zip(self.columns, self.units, strict=True)
        ]

    def to_si(self, raw: np.ndarray) -> np.ndarray:
        """Convert raw columns ``(T, K)`` to SI units."""
        if any(self.offset):
            raw = raw - self.offset
        return raw if (self.factors == 1).all() else raw * self.factors

    def from_si(self, values: np.ndarray) -> np.ndarray:
        """Convert columns ``(T, K)`` in SI units to the units of the file."""
        return values / self.factors + self.offset

    def check_units(self, signal: str, expected: Sequence[str]) -> None:
        """Raise a LogError if an SI unit is not among the expected units."""
        for column, unit in zip(self.columns, self.units, strict=True):
            if unit not in expected:
                raise LogError(f"{signal} has the column {column!r} in {unit}, expected {expected}")

    def in_order_of(self, columns: Sequence[str]) -> Columns:
        """Return the columns in the order of other columns with matching names.

        The names match if they differ among each other in the same way: ``dq1``, ``dq2`` and
        ``q1``, ``q2``. Columns without matching names, or named by numbers, keep their order.
        """
        names, order = _differences(self.columns), _differences(columns)
        if sorted(names) != sorted(order) or all(x.isdigit() for x in columns):
            return self
        ordered = {}
        for key in ("columns", "unit", "sign", "scale", "offset"):
            values = dict(zip(names, getattr(self, key), strict=True))
            ordered[key] = [values[x] for x in order]
        return replace(self, **ordered)

    def contradictions(self, signal: str, units: Mapping[str, str]) -> list[str]:
        """Return a sentence for each column whose unit differs from that of the file, ``units``."""
        texts = []
        for column, unit, factor in zip(self.columns, self.unit, self.factors, strict=True):
            name = known_unit(units.get(column, "")) or unit
            si, usual = to_si(name)
            # The conversion may be a part of ``scale``.
            differs = si == to_si(unit)[0] and usual != to_si(unit)[1]
            if differs and not math.isclose(abs(factor), usual):
                texts.append(
                    f"column {column!r} ({signal}) is in {name} by the header of the file, but "
                    f"the data set says {unit}: write unit: {name}"
                )
        return texts
