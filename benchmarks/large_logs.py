"""Time and memory to read large logs: python -m benchmarks.large_logs [gigabytes] [million rows].

A bag of JointStates of seven joints and a CSV file of 22 columns are written into a temporary
folder, without randomness. Each is read, loaded as a data source (read, checked, split and cut) and
looked at as check.py does, in a process each.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from pinn_dyn.data.logs import LogSource, Request
from pinn_dyn.data.logs.readers import read_tables
from pinn_dyn.log_check.check import check as check_log

RATE = 1000.0
JOINTS = [f"panda_joint{k + 1}" for k in range(7)]
ARRAYS = ("position", "velocity", "effort")
COLUMNS = [f"/joint_states/{array}/{joint}" for array in ARRAYS for joint in JOINTS]
BLOCK = 10_000


def signals(first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Stamps in ns, ``(count,)``, and positions, velocities and efforts, ``(count, 21)``."""
    number = np.arange(first, first + count)
    t = number[:, None] / RATE
    phase = 0.3 * np.arange(1, 8) * t + np.arange(7)
    stamps = np.int64(1_700_000_000_000_000_000) + np.int64(1e9 / RATE) * number
    return stamps, np.hstack([np.sin(phase), 0.3 * np.arange(1, 8) * np.cos(phase), phase % 3])


def write_bag(folder: Path, size: float) -> None:
    """A bag in MCAP of at least ``size`` bytes of messages."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/JointState"
    marks = 1e300 + np.arange(21) * 1e299  # where the numbers are in a message
    stamp = store.types["builtin_interfaces/msg/Time"](sec=0x01020304, nanosec=0x05060708)
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    message = store.types[kind](header, JOINTS, marks[:7], marks[7:14], marks[14:])
    raw = bytes(store.serialize_cdr(message, kind))
    places = [raw.index(mark.tobytes()) for mark in marks]
    seconds = raw.index((0x01020304).to_bytes(4, "little"))
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/joint_states", kind, typestore=store)
        for first in range(0, round(size / len(raw)), BLOCK):
            stamps, values = signals(first, BLOCK)
            rows = np.tile(np.frombuffer(raw, np.uint8), (BLOCK, 1))
            times = np.stack([stamps // 10**9, stamps % 10**9], axis=1).astype("<i4")
            rows[:, seconds : seconds + 8] = times.view(np.uint8)
            for k, place in enumerate(places):
                rows[:, place : place + 8] = values[:, k : k + 1].copy().view(np.uint8)
            for at, row in zip(stamps.tolist(), rows, strict=True):
                writer.write(connection, at, row.tobytes())


def write_csv(path: Path, rows: int) -> None:
    """A CSV file of t and 21 columns."""
    for first in range(0, rows, BLOCK):
        stamps, values = signals(first, min(BLOCK, rows - first))
        frame = pd.DataFrame(values, columns=COLUMNS)
        frame.insert(0, "/joint_states/t", 1e-9 * (stamps - stamps[0]) + first / RATE)
        frame.to_csv(path, mode="a", header=not first, index=False, float_format="%.6f")


def read(path: Path) -> str:
    """Read all columns; the number of rows in words."""
    (table,) = read_tables(path, Request("/joint_states/t", ["/joint_states/t", *COLUMNS])).values()
    _, values = signals(len(table) - 1, 1)
    assert np.allclose(table.frame[COLUMNS].iloc[-1], values, atol=1e-6)
    return f"{len(table)} rows read"


def source(path: Path) -> LogSource:
    """The log as a data source of seven joints."""
    q, v, u = (COLUMNS[7 * k : 7 * (k + 1)] for k in range(3))
    ends = {"seconds": 20.0, "piece": 10.0}
    return LogSource(
        name="large", root=str(path.parent), files=path.name,
        time={"columns": "/joint_states/t", "unit": "s"}, q={"columns": q, "unit": "rad"},
        v={"columns": v, "unit": "rad/s"}, u={"columns": u, "unit": "Nm"},
        validation=ends, test=ends,
    )  # fmt: skip


def load(path: Path) -> str:
    """Load the log as a training does; the number of samples in words."""
    splits = source(path).load()
    return f"{sum(len(run.t) for run in splits.train)} samples of training loaded"


def check(path: Path) -> str:
    """Look at the log as check.py does, figures left out; the number of warnings in words."""
    return f"{len(check_log(source(path)).warnings)} warnings of the check"


WORK = {work.__name__: work for work in (read, load, check)}


def measure(work: Callable[[Path], str], path: Path) -> None:
    """Do it; prints what was done, seconds and the most memory that it took."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start, processor = time.perf_counter(), time.process_time()
    done = work(path)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(
        f"{path.name}: {done} in {time.perf_counter() - start:.1f} s "
        f"({time.process_time() - processor:.1f} s of the processor), at most {most / 1e6:.2f} GB, "
        f"of which {before / 1e6:.2f} GB are Python's and the packages'",
        flush=True,
    )


def main(gigabytes: float, million_rows: float) -> None:
    """Write both and read each in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        if gigabytes:
            write_bag(place / "bag", 1e9 * gigabytes)
        if million_rows:
            write_csv(place / "log.csv", round(1e6 * million_rows))
        for path in sorted(place.iterdir()):
            for work in WORK:
                subprocess.run(
                    [sys.executable, "-m", "benchmarks.large_logs", work, str(path)], check=True
                )


if __name__ == "__main__":
    if sys.argv[1:] and sys.argv[1] in WORK:
        measure(WORK[sys.argv[1]], Path(sys.argv[2]))
    else:
        given = [float(word) for word in sys.argv[1:]] + [1.0, 5.0][len(sys.argv) - 1 :]
        main(*given)
