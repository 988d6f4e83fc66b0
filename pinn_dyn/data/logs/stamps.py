"""Times of the rows of a log, from columns of numbers, dates or times of day, or from a rate."""

from __future__ import annotations

import warnings
from dataclasses import field
from typing import Annotated

import numpy as np
import pandas as pd
from pydantic import PositiveFloat
from pydantic.dataclasses import dataclass

from pinn_dyn import wording
from pinn_dyn.data.logs.columns import STRICT, UNITS, Columns, PerColumn
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.table import Table

SAMPLE_TIMES = (1e-5, 0.5)
"""Plausible sample times, s."""
_SINCE_1970 = 1e8  # smallest time that counts from 1970, s
_COUNTERS = (2**16, 2**32)  # numbers of values of counters with 16 and 32 bits
_CYCLES = (86400, 2**32 * 1e-3, 2**32 * 1e-6)  # a day; 32 bits of milli- and microseconds, s
_WRAP_SAMPLES = 10  # longest step across the end of a counter, in usual sample times


@dataclass(config=STRICT)
class Clock(Columns):
    """Times of the rows: the sum of columns, or a rate.

        t_k = Σ_i sign_i scale_i factor(unit_i) (raw_ki - offset_i)    or    t_k = k / rate

    Dates, times of day and durations, as text or as types of pandas, need no unit. A counter that
    overflows is unwrapped. A column with a single repeated number is the sample time.

    Args:
        columns: columns of the time, such as seconds and nanoseconds; or a name of the index of a
            data frame, or ``index``.
        unit: unit of numbers.
        rate: samples per second of a log without time, Hz; replaces the columns.
    """

    columns: Annotated[list[str], PerColumn] = field(default_factory=list)
    unit: Annotated[list[str], PerColumn] = field(default_factory=lambda: ["s"])
    rate: PositiveFloat | None = None

    def __post_init__(self) -> None:
        if self.rate is not None:
            self.columns, self.unit = [], []
        elif not self.columns:
            rate = wording.entry("time", {"rate": 100})
            raise LogError(f"expected columns, or a rate, as in {rate}")
        super().__post_init__()
        self.check_units("time", ["s"])

    @property
    def name(self) -> str:
        """Columns of the time, for messages."""
        return ", ".join(self.columns)

    def seconds(self, table: Table, origin: Table | None = None) -> tuple[np.ndarray, list[str]]:
        """Return the times of the rows of a run, ``(T,)``, s, and notes.

        Times since 1970 are relative to the first row of ``origin``, by default of the table.
        Differences of integers are exact.
        """
        if self.rate is not None:
            return np.arange(len(table)) / self.rate, [f"a clock of {self.rate:g} Hz"]
        start = 0.0
        times, elapsed = np.zeros(len(table)), np.zeros(len(table))
        notes: list[str] = []
        for k, name in enumerate(self.columns):
            raw, count = self._counts(table, name)
            first = raw[0] if origin is None else self._counts(origin, name)[0][0]
            factor = count or self.factors[k]
            offset = 0.0 if count else self.offset[k]
            if len(self.columns) == 1:
                raw, notes = _unwrapped(raw, factor)
            start += factor * (first - offset)
            times += (raw - offset) * factor
            elapsed += (raw - first) * factor
        t = elapsed if abs(start) > _SINCE_1970 else times
        if len(t) > 2 and np.ptp(t) == 0 and SAMPLE_TIMES[0] <= t[0] <= SAMPLE_TIMES[1]:
            return t[0] * np.arange(len(t)), [f"{self.name} is a sample time of {t[0]:.6g} s"]
        return t, notes

    def plausible_unit(self, table: Table, sample_time: float) -> str:
        """Return a unit that makes an implausible sample time, s, plausible, or ""."""
        if len(self.columns) > 1 or self._counts(table, self.columns[0])[1]:
            return ""
        counts = sample_time / self.factors[0]
        usual = {x: factor * counts for x, (si, factor) in UNITS.items() if si == "s"}
        low, high = SAMPLE_TIMES
        units = [unit for unit, size in usual.items() if low <= size <= high]
        return min(units, key=lambda unit: abs(np.log(100 * usual[unit])), default="")

    def _counts(self, table: Table, name: str) -> tuple[np.ndarray, float | None]:
        """Return a column as numbers ``(T,)``, and, for dates and times, the seconds per count."""
        try:
            raw = table.column(name, "time")
        except LogError as error:
            rate = wording.entry("time", {"rate": 100})
            text = f"{error}. Without a clock, state the rate in Hz instead, as in {rate}"
            raise LogError(text) from None
        cells = raw
        if raw.dtype.kind not in "mM":
            numbers = pd.to_numeric(raw, errors="coerce")
            if numbers.dtype.kind in "iu":
                return numbers.to_numpy(np.int64), None
            if numbers.notna().any():
                raw = pd.Series(table.numbers([name], "time")[:, 0])
            else:
                raw = _dates(raw.astype(str))
        if (bad := raw.isna()).any():
            row = int(bad.to_numpy().argmax())
            raise LogError(
                f"{table.place(row, name, 'time')}: the value is {str(cells.iloc[row])[:80]!r}, "
                "expected a number, or a date or time as text "
                f"({int(bad.sum())} such rows): repair or remove the rows"
            )
        if raw.dtype.kind == "f":
            return raw.to_numpy(), None
        kind = "timedelta64[ns]" if raw.dtype.kind == "m" else "datetime64[ns]"
        return raw.to_numpy(kind).astype(np.int64), 1e-9


def _dates(text: pd.Series) -> pd.Series:
    """Parse texts as dates or as times of day; NaT for texts that are neither."""
    text = text.str.strip().str.replace(r"(:\d\d)(?:,|:(?=\d{3}))(\d+)", r"\1.\2", regex=True)
    trials = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # pandas warns of formats without a pattern
        for parse, options in (
            (pd.to_datetime, {"format": "ISO8601", "utc": True}),
            (pd.to_timedelta, {}),
            (pd.to_datetime, {"utc": True}),
        ):
            trials.append(parse(text, errors="coerce", **options))
            if trials[-1].notna().all():
                break
    return max(trials, key=lambda stamps: int(stamps.notna().sum()))


def _unwrapped(raw: np.ndarray, factor: float) -> tuple[np.ndarray, list[str]]:
    """Unwrap a counter that jumps back by its range, and return a note."""
    back = np.diff(raw) < 0
    if not back.any() or back.all():
        return raw, []
    longest = _WRAP_SAMPLES * np.median(np.diff(raw)[~back])
    for period in (*_COUNTERS, *(x / factor for x in _CYCLES)):
        turned = np.unwrap(raw, period=period)
        steps = np.diff(turned)[back]
        wraps = (steps >= 0) & (steps <= longest)
        if wraps.any() and longest < period / 4:
            return turned, [f"the time wraps {wraps.sum()} times and is continued"]
    return raw, []
