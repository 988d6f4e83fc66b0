"""Small logs on disk for the tests: an oscillator under a known force."""

import numpy as np
import pandas as pd

from pinn_dyn.data.logs import LogSource, Recording

RATE = 100.0


def motion(seconds=10.0, phase=0.0, rate=RATE):
    """Two sinusoidal coordinates, their velocities, and forces q'' + 4 q, as a table."""
    t = np.arange(round(seconds * rate) + 1) / rate
    table = {"t": t}
    for k, (w, size) in enumerate(((1.5, 0.6), (2.3, 0.4)), start=1):
        beat = np.sin(0.37 * t + phase)
        q = size * (np.sin(w * t + phase) + beat)
        a = size * (-(w**2) * np.sin(w * t + phase) - 0.37**2 * beat)
        table |= {
            f"q{k}": q,
            f"v{k}": size * (w * np.cos(w * t + phase) + 0.37 * np.cos(0.37 * t + phase)),
            f"u{k}": a + 4 * q,
        }
    return pd.DataFrame(table)


def write(folder, table, name="run.csv"):
    table.to_csv(folder / name, index=False, float_format="%.12g")


def source(folder, **changes):
    """A source of the two-coordinate oscillator, split by time."""
    arguments = dict(
        name="oscillator",
        root=str(folder),
        files="*.csv",
        time=dict(columns="t", unit="s"),
        q=dict(columns=["q1", "q2"], unit="rad"),
        v=dict(columns=["v1", "v2"], unit="rad/s"),
        u=dict(columns=["u1", "u2"], unit="Nm"),
        validation=dict(seconds=1.0, piece=0.5),
        test=dict(seconds=2.0, piece=1.0),
        guard=0.5,
    )
    return LogSource(**{**arguments, **changes})


def named(pattern, time=None):
    """Columns of a source whose names follow a pattern of the signal and its number."""
    units = {"q": "rad", "v": "rad/s", "u": "Nm"}
    columns = {
        key: dict(columns=[pattern.format(key, k) for k in (1, 2)], unit=unit)
        for key, unit in units.items()
    }
    return columns if time is None else columns | {"time": dict(columns=time, unit="s")}


def arrays_of(table):
    """The signals of a table, ``(T,)`` and ``(T, 2)``."""
    pairs = {name: table[[f"{name}1", f"{name}2"]].to_numpy() for name in "qvu"}
    return {"t": table["t"].to_numpy()} | pairs


def assert_read(log, table, count=1):
    """Most rows of a table, in so many runs, are the recordings of a source without steps."""
    parts = [part.raw for part in log.cleaned]
    assert len({part.run for part in parts}) == count
    assert sum(map(len, parts)) > 0.7 * count * len(table)
    arrays = arrays_of(table)
    for part in parts:
        rows = np.round(RATE * part.t).astype(int)
        for name in "tqvu":
            values = getattr(part, name)
            if values is not None:
                np.testing.assert_allclose(values, arrays[name][rows], atol=1e-7)


def recording(q, *, t=None, v=None, u=None, rate=RATE):
    """A recording of given columns; the input is random where none is given."""
    q = np.asarray(q, dtype=float).reshape(len(q), -1)
    t = np.arange(len(q)) / rate if t is None else np.asarray(t, dtype=float)
    u = np.random.default_rng(1).normal(size=(len(q), 1)) if u is None else np.asarray(u)
    return Recording("run", t, q, v, u.reshape(len(q), -1))
