"""Bags of ROS 1 and ROS 2, MCAP included, as tables; decoded by rosbags, without ROS.

A column is ``<topic>/<field>``, as ``/joint_states/position/panda_joint1`` or ``/commands/data/2``.
``<topic>/t`` is the time of a message, s: that of its header, or when the bag received it. The
topic of the time column has the rows. Of other topics a row takes the last message before it that
is not older than ``max_age``; rows without such a message are dropped.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pinn_dyn.data.cache import cache_key
from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.table import Request, Table, optional
from pinn_dyn.data.whole import whole

# Names of the entries of a message's arrays, in sensor_msgs and trajectory_msgs.
_NAMES = ("name", "joint_names")


def read_bag(path: Path, request: Request) -> Table:
    """Read columns of a bag, one row per message of the topic of the time."""
    optional("pyarrow", path)
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    stats = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    fields = list(dict.fromkeys([request.time, *request.columns]))
    key = cache_key([str(path.absolute()), stats, fields, request.max_age])
    folder = Path(os.environ.get("PINN_DYN_CACHE", "~/.cache/pinn_dyn")).expanduser()
    cached = folder / f"bag-{key}.parquet"
    if not cached.is_file():
        frame = _merge(path, _decode(path, fields), request)
        folder.mkdir(parents=True, exist_ok=True)
        with whole(cached) as partial:
            frame.to_parquet(partial)
    frame = pd.read_parquet(cached)
    return Table(frame, str(path), "message", notes=frame.attrs["notes"])


def _decode(path: Path, columns: Sequence[str]) -> dict[str, pd.DataFrame]:
    highlevel = optional("rosbags.highlevel", path)
    stores = optional("rosbags.typesys", path)
    # Old bags hold no definitions of their messages: the common ones are known.
    store = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    with highlevel.AnyReader([path], default_typestore=store) as reader:
        fields = _fields_of_topics(path, reader, columns)
        numbers: dict[str, list[list[float]]] = {topic: [] for topic in fields}
        connections = [item for item in reader.connections if item.topic in fields]
        for connection, stamp, raw in reader.messages(connections):
            message = reader.deserialize(raw, connection.msgtype)
            time = _time(message, stamp)
            topic = f"{path}, topic {connection.topic}"
            values = [
                time if field == "t" else _number(message, field, topic)
                for field in fields[connection.topic].values()
            ]
            numbers[connection.topic].append([time, *values])
    topics = {}
    for topic, names in fields.items():
        frame = pd.DataFrame(numbers[topic], columns=["", *names], dtype=float).set_index("")
        if (empty := frame.isna().all()).any():
            raise LogError(f"{path}: no message has a value of {empty.idxmax()!r}")
        topics[topic] = frame
    return topics


def _fields_of_topics(path: Path, reader: Any, columns: Sequence[str]) -> dict[str, dict[str, str]]:
    topics = sorted(reader.topics, key=len, reverse=True)
    fields: dict[str, dict[str, str]] = {}
    for column in columns:
        topic = next((name for name in topics if column.startswith(f"{name}/")), None)
        if topic is None:
            names = listed(f"{name} ({x.msgtype})" for name, x in sorted(reader.topics.items()))
            raise LogError(f"{path}: no topic for the column {column!r}: the bag has {names}")
        fields.setdefault(topic, {})[column] = column[len(topic) + 1 :]
    return fields


def _time(message: Any, received: int) -> float:
    """Return the time of a message, s, from its header or from when the bag received it, ns."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is not None and (stamp.sec or stamp.nanosec):
        received = 10**9 * stamp.sec + stamp.nanosec
    return 1e-9 * received


def _number(message: Any, field: str, topic: str) -> float:
    """Return the number at a path such as ``position/joint1``; NaN for a missing entry."""
    node = message
    for step in field.split("/"):
        if hasattr(node, "__len__") and not isinstance(node, str):
            names = next((list(getattr(message, x)) for x in _NAMES if hasattr(message, x)), [])
            k = int(step) if step.isdigit() else names.index(step) if step in names else len(node)
            if k >= len(node):
                return np.nan
            node = node[k]
        elif hasattr(node, step):
            node = getattr(node, step)
        else:
            names = [name for name in message.__dataclass_fields__ if not name.startswith("__")]
            raise LogError(f"{topic}: no {field!r} in its messages, which have {listed(names)}")
    if not isinstance(node, (int, float, np.number, np.bool_)):
        kind = type(node).__name__
        raise LogError(f"{topic}: {field!r} is a {kind}, expected a number, or '<topic>/t'")
    return float(node)


def _merge(path: Path, topics: dict[str, pd.DataFrame], request: Request) -> pd.DataFrame:
    clock = next(topic for topic, frame in topics.items() if request.time in frame)
    frame = topics.pop(clock)
    times = frame[request.time].to_numpy()
    frame.index = pd.RangeIndex(1, len(frame) + 1)
    for messages in topics.values():
        messages = messages.dropna().sort_index(kind="stable")
        messages = messages[~messages.index.duplicated(keep="last")]
        latest = messages.reindex(times, method="ffill", tolerance=request.max_age)
        frame[messages.columns] = latest.to_numpy()
    rows = frame.dropna()
    dropped = (
        f"{len(frame) - len(rows)} of {len(frame)} messages of {clock} are dropped: they lack an "
        f"entry, or a message of {listed(topics)} in the {request.max_age:g} s before them"
    )
    if not len(rows):
        raise LogError(f"{path}: no row is left: {dropped}")
    rows.attrs["notes"] = [dropped] if len(rows) < len(frame) else []
    return rows
