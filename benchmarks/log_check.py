"""Processor time and memory of the check of a log: python -m benchmarks.log_check [seconds].

The log has seven joints at 1 kHz, noise, friction and a URDF; in a second one, a joint is 0.4 rad
off, and its cause is searched. Each is checked in a process.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time

import numpy as np
import pandas as pd

from pinn_dyn.data.logs import LogSource
from pinn_dyn.log_check.check import check
from tests.support.delayed_robots import seven_joints, seven_torques, sines

RATE, BLOCK = 1000, 5000
OFFSETS = {"clean": 0.0, "q4 is 0.4 rad off": 0.4}


def source(seconds: float, offset: float) -> LogSource:
    """One run of seven joints."""
    rng = np.random.default_rng(0)
    motion = sines(rng, 7, size=0.8, highest=0.6)
    t = np.arange(round(seconds * RATE)) / RATE
    q, v, a = (motion(t, order) for order in range(3))
    parts = range(0, len(t), BLOCK)
    u = np.concatenate([seven_torques(*(x[k : k + BLOCK] for x in (q, v, a))) for k in parts])
    q = q + 1e-5 * rng.normal(size=q.shape) + offset * (np.arange(7) == 3)
    v = v + 1e-3 * rng.normal(size=q.shape)
    u = u * (1 + 0.01 * rng.normal(size=q.shape))
    names = {name: [f"{name}{k}" for k in range(1, 8)] for name in "qvu"}
    columns = [x for name in "qvu" for x in names[name]]
    frame = pd.DataFrame(np.column_stack([t, q, v, u]), columns=["t", *columns])
    return LogSource(
        name="seven",
        files=frame,
        time="t",
        q={"columns": names["q"], "unit": "rad"},
        v={"columns": names["v"], "unit": "rad/s"},
        u={"columns": names["u"], "unit": "Nm"},
    )


def measure(seconds: float, name: str) -> None:
    """Print the processor time and the memory that the check takes beside the loaded log."""
    log = source(seconds, OFFSETS[name])
    log.load()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.process_time()
    report = check(log, structure=seven_joints())
    seconds_taken = time.process_time() - start
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    arrays = seconds * RATE * 22 * 8 / 1e6
    memory = f"{(most - before) / 1e3:.0f} MB beside the loaded log ({arrays:.0f} MB of arrays)"
    count = len(report.findings())
    print(f"{name}, {seconds:g} s: {seconds_taken:.1f} s, {memory}, {count} findings", flush=True)


if __name__ == "__main__":
    if len(sys.argv) == 3:
        measure(float(sys.argv[1]), sys.argv[2])
    else:
        for kind in OFFSETS:
            duration = sys.argv[1] if sys.argv[1:] else "60"
            command = [sys.executable, "-m", "benchmarks.log_check", duration, kind]
            subprocess.run(command, check=True)
