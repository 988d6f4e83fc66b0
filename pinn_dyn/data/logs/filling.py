"""Fill empty cells of signals with slower clocks, such as those of joined topics."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.recording import Recording, Report, clock_steps
from pinn_dyn.data.logs.table import Table

_SLOWER = 0.1  # share of empty cells from which a signal has a slower clock
_LOST = 1.8  # usual sample times of q between two samples from which a sample is lost
_MISSED = 3  # usual sample times of a signal that are filled in any case


def fill(
    recording: Recording,
    signals: Mapping[str, Columns],
    table: Table,
    max_age: float,
    report: Report,
    *,
    splits: bool,
) -> np.ndarray:
    """Fill the empty cells of a run in place: hold u, interpolate q and v linearly.

    Rows between two samples of the first column of q are dropped. A cell stays empty if its
    neighboring values are further apart than both ``max_age``, s, and three usual sample times of
    the column. Rows with empty cells are dropped, too.

    Args:
        recording: rows in the order of their times, with NaN in empty cells.
        signals: columns of each signal.
        table: the same rows as a table, for messages.
        max_age: see above, s.
        report: report that gets notes and warnings.
        splits: true if a later step splits runs where rows are missing.

    Returns:
        Mask ``(T,)`` of the rows that are not dropped.

    Raises:
        LogError: if a column has no value, all rows are dropped, or rows are dropped in the middle
            of a run and ``splits`` is false.
    """
    t, run = recording.t, recording.run
    clock = ~np.isnan(recording.q[:, 0])
    if len(times := t[clock]) > 1:  # rows between samples of q belong to other signals
        age, _ = _filled(times, times, t, hold=False)
        clock |= np.isfinite(age) & (age > _LOST * np.median(np.diff(times)))
    stays = clock.copy()
    for signal, columns in signals.items():
        filled: dict[str, np.ndarray] = {}
        for k, name in enumerate(columns.columns):
            x = getattr(recording, signal)[:, k]
            present = ~np.isnan(x)
            if not present.any():
                raise LogError(f"{table.name}: the column {name!r} ({signal}) has no values")
            empty = np.flatnonzero(clock & ~present)
            age, x[empty] = _filled(t[present], x[present], t[empty], hold=signal == "u")
            usual = np.median(np.diff(t[present])) if present.sum() > 1 else 0.0
            longest = max(max_age, _MISSED * float(usual))
            good = age <= longest
            stays[empty[~good]] = False
            if good.any():
                filled[name] = age[good]
            inside = np.isfinite(age) & ~good
            if inside.any():
                text = (
                    f"{table.place(int(empty[inside][0]), name, signal)}: no value for "
                    f"{age[inside].max():.3g} s, more than {longest:.3g} s (max_age)"
                )
                if not splits:
                    raise LogError(f"{text}: split the run there, as in{clock_steps(t[clock])}")
                report.warn("empty cells", f"{text}: {inside.sum()} rows are dropped")
        if filled:
            count, distance = max(map(len, filled.values())), max(map(np.max, filled.values()))
            text = (
                f"{count} of {clock.sum()} values of {signal} ({', '.join(filled)}) are missing "
                f"and {'held' if signal == 'u' else 'interpolated'}, over at most {distance:.3g} s"
            )
            if count > _SLOWER * clock.sum():
                report.add("Read", run, text)
            else:
                report.warn("empty cells", f"{table.name}: {text}")
    if not stays.any():
        raise LogError(
            f"{table.name}: no row has values of {', '.join(signals)}: do they have the same clock?"
        )
    if dropped := int((clock & ~stays).sum()):
        report.add("Read", run, f"{dropped} of {clock.sum()} rows lack a value and are dropped")
    return stays


def _filled(
    times: np.ndarray, x: np.ndarray, at: np.ndarray, *, hold: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the time between the neighboring values of each time, s, and the filled values."""
    last = np.searchsorted(times, at, side="right") - 1
    following = np.searchsorted(times, at)
    age = np.where(last < 0, np.inf, np.r_[times, np.inf][following] - times[last])
    if not hold:
        return age, np.interp(at, times, x)
    # The last value of a signal is held, too.
    return np.where(following < len(times), age, at - times[last]), x[last]
