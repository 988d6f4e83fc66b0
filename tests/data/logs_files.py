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


def recording(q, *, t=None, v=None, u=None, rate=RATE):
    """A recording of given columns; the input is random where none is given."""
    q = np.asarray(q, dtype=float).reshape(len(q), -1)
    t = np.arange(len(q)) / rate if t is None else np.asarray(t, dtype=float)
    u = np.random.default_rng(1).normal(size=(len(q), 1)) if u is None else np.asarray(u)
    return Recording("run", t, q, v, u.reshape(len(q), -1))
