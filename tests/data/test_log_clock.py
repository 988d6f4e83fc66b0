"""Clocks of logs: counters, dates, an index, two columns, a rate, and repairs of bad clocks."""

import re

import numpy as np
import pandas as pd
import pytest

from pinn_dyn.data.logs import Deduplicate, LogError
from pinn_dyn.data.logs.stamps import Clock
from pinn_dyn.data.logs.table import Table
from tests.data.logs_files import motion, source, write

SECONDS = motion()["t"]
NS = np.int64(1_790_000_000_123_456_789) + (1e9 * SECONDS).round().astype(np.int64)
STAMPS = pd.to_datetime(NS)


def texts(form):
    return STAMPS.dt.strftime(form).str.slice(stop=-3)


CLOCKS = {
    "rate": (None, dict(rate=100)),
    "seconds and nanoseconds": (
        {"secs": NS // 10**9, "nsecs": NS % 10**9},
        dict(columns=["secs", "nsecs"], unit=["s", "ns"]),
    ),
    "integer nanoseconds": ({"t": NS}, dict(columns="t", unit="ns")),
    "ISO 8601": ({"t": [x.isoformat() for x in STAMPS.dt.tz_localize("UTC")]}, {}),
    "ISO 8601 with zones": (
        {"t": [x.isoformat() for x in (STAMPS + pd.Timedelta("36.5d")).dt.tz_localize("UTC")
               .dt.tz_convert("Europe/Berlin")]},
        {},
    ),
    "German": ({"t": texts("%d.%m.%Y %H:%M:%S,%f")}, {}),
    "time of day": ({"t": texts("%H:%M:%S.%f")}, {}),
    "midnight": ({"t": (STAMPS + pd.Timedelta("10:46:31")).dt.strftime("%H:%M:%S.%f")}, {}),
    "date and time": (
        {"day": STAMPS.dt.strftime("%Y-%m-%d"), "time": texts("%H:%M:%S.%f")},
        dict(columns=["day", "time"]),
    ),
    "days of MATLAB": ({"t": (719529 + NS / 86400e9).map("{:.12f}".format)}, "d"),
    "micros()": ({"t": (2**32 - 4_000_000 + (1e6 * SECONDS).round().astype(int)) % 2**32}, "us"),
    "16 bits": ({"t": (65_000 + (1e3 * SECONDS).round().astype(int)) % 2**16}, "ms"),
    "sample time": ({"t": 0.01 + 0 * SECONDS}, {}),
}  # fmt: skip


@pytest.mark.parametrize("clock", CLOCKS)
def test_every_clock_gives_the_same_times(tmp_path, clock):
    columns, time = CLOCKS[clock]
    table = motion().drop(columns="t")
    write(tmp_path, table if columns is None else table.assign(**columns))
    time = dict(columns="t", unit=time) if isinstance(time, str) else time
    log = source(tmp_path, time=time or dict(columns="t", unit="s"))
    times = np.sort(np.concatenate([part.raw.t for part in log.cleaned]))
    assert not log.warnings
    np.testing.assert_allclose(np.median(np.diff(times)), 0.01, atol=1e-5)
    np.testing.assert_allclose(np.ptp(times), 10.0, atol=1e-4)
    assert len(log.load().train[0].t) == 601


def test_the_time_is_the_sum_of_its_scaled_columns():
    clock = Clock(["s", "ms"], ["s", "ms"], sign=[1, -1], scale=[1.0, 0.5], offset=[10.0, 4.0])
    table = Table(pd.DataFrame({"s": [10, 11, 13], "ms": [4.0, 8.0, 0.0]}), "log")
    np.testing.assert_allclose(clock.seconds(table)[0], [0, 0.998, 3.002])


FRAMES = {
    "dates": ("index", STAMPS),
    "dates in ms with a zone": ("index", STAMPS.dt.tz_localize("Asia/Tokyo").dt.as_unit("ms")),
    "column of dates": ("stamp", None),
}


@pytest.mark.parametrize("index", FRAMES)
def test_the_index_of_a_frame_is_its_clock(index):
    time, values = FRAMES[index]
    frame = motion().drop(columns="t").assign(stamp=STAMPS)
    log = source(".", files=frame if values is None else frame.set_index(values), time=time)
    np.testing.assert_allclose(log.load().train[0].t.diff(), 0.01, atol=1e-9)


ADVICE = {
    "no clock": (motion().drop(columns="t"), dict(rate=100)),
    "constant": (motion().assign(t=7.0), dict(rate=100)),
    "dates": (
        motion().assign(t=STAMPS[0] + pd.to_timedelta(100 * SECONDS, unit="s")),
        dict(rate=1),
    ),
    "ms": (motion().assign(t=1000 * SECONDS), dict(columns="t", unit="ms")),
    "UNIX ns": (motion().assign(t=NS), dict(columns="t", unit="ns")),
}


@pytest.mark.parametrize("fault", ADVICE)
def test_the_advice_on_a_clock_works_on_the_log_that_gets_it(tmp_path, fault, language):
    table, cure = ADVICE[fault]
    write(tmp_path, table)
    with pytest.raises(LogError) as error:
        source(tmp_path).load()
    advice = f"write the unit {cure.get('unit')},"
    if "rate" in cure:
        rate = cure["rate"]
        advice = {"python": rf"time={{'rate': {rate}(\.0)?}}", "yaml": f"time: {{rate: {rate}}}"}
        advice = advice[language]
    assert re.search(advice, str(error.value))
    assert "unit" in cure or "write the unit" not in str(error.value)
    step = 1 / cure.get("rate", 100)
    if step < 1:
        np.testing.assert_allclose(source(tmp_path, time=cure).load().train[0].t.diff(), step)


def test_a_restart_of_the_clock_starts_a_run(tmp_path):
    runs = [motion(), motion(phase=1.0), motion(phase=2.0)]
    write(tmp_path, pd.concat(runs))
    log = source(tmp_path)
    assert len(log.load().train) == 3
    assert "the time goes back to 0 s: a run is assumed to start" in "\n".join(log.warnings)


def test_rows_out_of_order_are_sorted(tmp_path):
    write(tmp_path, motion().iloc[np.r_[0:300, 305, 300:305, 306:1001]])
    log = source(tmp_path)
    np.testing.assert_allclose(log.load().train[0].q[:, 0], motion()["q1"][:602][:601])
    assert "the time goes back to 3 s: rows out of order are sorted" in "\n".join(log.warnings)


def test_a_logger_faster_than_its_source_is_no_burst(tmp_path):
    write(tmp_path, motion().iloc[np.arange(10010) // 10])
    with pytest.raises(LogError, match="Deduplicate") as error:
        source(tmp_path).load()
    assert "RowClock" not in str(error.value)
    log = source(tmp_path, steps={"once": Deduplicate()})
    np.testing.assert_allclose(log.load().train[0].q[:, 0], motion()["q1"][:601])
    assert not log.warnings
