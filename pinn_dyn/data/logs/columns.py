"""Which columns hold a signal, and how their numbers become SI."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import numpy as np

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.units import to_si
from pinn_dyn.spelling import did_you_mean

_Described = TypeVar("_Described", bound="ShortForm")


class ShortForm:
    """What a config describes by a mapping of its arguments, without a ``_target_``.

    Attributes:
        form: an example of such a mapping.
        needed: keys that it must have.
    """

    form: ClassVar[str]
    needed: ClassVar[tuple[str, ...]]

    @classmethod
    def from_config(cls: type[_Described], name: str, given: Any) -> _Described:
        """An object, as it is or from its short form.

        Args:
            name: where it is given.
            given: the object or the mapping.

        Raises:
            LogError: naming the key that is missing or misspelt, or with what the class said.
        """
        if isinstance(given, cls):
            return given
        if not isinstance(given, Mapping):
            raise LogError(f"{name} is {given!r}, expected {cls.form}")
        keys = list(inspect.signature(cls).parameters)
        for key in given:
            if key not in keys:
                hint = did_you_mean(key, keys)
                raise LogError(f"{name} has the key {key!r}, expected {', '.join(keys)}{hint}")
        for key in cls.needed:
            if given.get(key) is None:
                raise LogError(f"{name}.{key} is missing: expected {cls.form}")
        try:
            return cls(**given)
        except LogError as error:
            raise LogError(f"{name}: {error}") from error


class Columns(ShortForm):
    """The columns of one signal.

        x = sign * scale * factor(unit) * (raw - offset)

    with the offset in the unit of the file. All but ``columns`` is one value, or one per column.

    Args:
        columns: names of the columns in the file.
        unit: unit in the file, see :data:`~pinn_dyn.data.logs.UNITS`.
        sign: 1 or -1.
        scale: factor beside that of the unit, such as a gear ratio.
        offset: what the file shows at zero.

    Raises:
        LogError: on an empty or repeated column, an unknown unit, or lengths that differ.
    """

    form = "{columns: [...], unit: ...}"
    needed = ("columns", "unit")

    def __init__(
        self,
        columns: str | Sequence[str],
        *,
        unit: str | Sequence[str],
        sign: float | Sequence[float] = 1,
        scale: float | Sequence[float] = 1.0,
        offset: float | Sequence[float] = 0.0,
    ):
        self.columns = [columns] if isinstance(columns, str) else [str(name) for name in columns]
        if not self.columns:
            raise LogError("columns is empty: expected at least one name")
        repeated = sorted({name for name in self.columns if self.columns.count(name) > 1})
        if repeated:
            raise LogError(f"columns names {', '.join(repeated)} twice: expected each once")
        self.file_units = self._each("unit", unit)
        si = [to_si(name) for name in self.file_units]
        self.units = [name for name, _ in si]
        signs = self._numbers("sign", sign)
        if not np.isin(signs, (-1, 1)).all():
            raise LogError(f"sign is {sign}, expected 1 or -1 (a factor belongs in scale)")
        scales = self._numbers("scale", scale)
        if not np.isfinite(scales).all() or (scales == 0).any():
            raise LogError(f"scale is {scale}, expected numbers that are not 0")
        self.factors = signs * scales * np.array([factor for _, factor in si])
        self.offsets = self._numbers("offset", offset)
        if not np.isfinite(self.offsets).all():
            raise LogError(f"offset is {offset}, expected finite numbers")

    @property
    def labels(self) -> list[str]:
        """Name and SI unit of each column, as in ``q1 [rad]``."""
        return [
            name if unit == "1" else f"{name} [{unit}]"
            for name, unit in zip(self.columns, self.units, strict=True)
        ]

    def to_si(self, raw: np.ndarray) -> np.ndarray:
        """Raw columns ``(T, K)`` in SI units."""
        values = raw - self.offsets
        values *= self.factors
        return values

    def from_si(self, values: np.ndarray) -> np.ndarray:
        """Columns ``(T, K)`` in SI units as the file has them."""
        return values / self.factors + self.offsets

    def _numbers(self, name: str, value: Any) -> np.ndarray:
        try:
            return np.array(self._each(name, value), dtype=float)
        except (TypeError, ValueError) as error:
            raise LogError(f"{name} is {value!r}, expected a number: {error}") from error

    def _each(self, name: str, value: Any) -> list[Any]:
        """One value per column."""
        if isinstance(value, Sequence) and not isinstance(value, str):
            if len(value) != len(self.columns):
                raise LogError(
                    f"{name} has {len(value)} entries, expected one, or one for each of the "
                    f"{len(self.columns)} columns"
                )
            return list(value)
        return [value] * len(self.columns)


def check_units(name: str, columns: Columns, expected: Sequence[str]) -> None:
    """Refuse columns whose SI unit is none of those expected.

    Raises:
        LogError: naming the column.
    """
    for label, unit in zip(columns.columns, columns.units, strict=True):
        if unit not in expected:
            raise LogError(
                f"{name} has the column {label!r} in {unit}, expected {', '.join(expected)}: is it "
                "the right column, and its unit?"
            )


def check_columns(signals: Mapping[str, Columns]) -> None:
    """Refuse a column that two signals ask for: one of them would explain the other.

    Raises:
        LogError: naming the column and both.
    """
    taken: dict[str, str] = {}
    for signal, columns in signals.items():
        for name in columns.columns:
            if name in taken:
                raise LogError(
                    f"column {name!r} is given for {taken[name]} and for {signal}, expected for "
                    "one of them"
                )
            taken[name] = signal
