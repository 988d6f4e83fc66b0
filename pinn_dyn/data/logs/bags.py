"""Bags of ROS 1 and ROS 2, MCAP included, as tables; decoded by rosbags, without ROS.

A column is ``<topic>/<field>``, as ``/joint_states/position/panda_joint1``: an entry of an array is
picked by the joint's name, where the message has names, or by its number from 0, as in
``/commands/data/2``. ``<topic>/t`` is the time of a message, s: that of its header, or where it has
none, when the bag received it.

The topic of the time column has the rows. Of every other topic a row takes the last message that is
not later than it, and not older than ``max_age``; rows without such a message are dropped.
"""

from __future__ import annotations

import json
import os
from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pinn_dyn.data.cache import cache_key
from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.readers import Request, optional
from pinn_dyn.data.logs.table import Table
from pinn_dyn.data.whole import whole

# Names of the entries of a message's arrays, in sensor_msgs and trajectory_msgs.
_NAMES = ("name", "joint_names")


def read_bag(path: Path, request: Request) -> Table:
    """Read columns of a bag, one row per message of the topic of the time.

    The decoded messages are kept as Parquet files in the cache, since decoding takes 20 µs each.

    Raises:
        LogError: on topics, fields or joints that the bag does not have, and on topics whose
            clocks never overlap.
    """
    optional("pyarrow", path)
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    stats = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    fields = list(dict.fromkeys([request.time, *request.columns]))
    key = cache_key([str(path.absolute()), stats, fields])
    folder = Path(os.environ.get("PINN_DYN_CACHE", "~/.cache/pinn_dyn")).expanduser()
    index = folder / f"bag-{key}.json"
    if index.is_file():
        topics = {
            topic: pd.read_parquet(folder / file)
            for topic, file in json.loads(index.read_text()).items()
        }
    else:
        topics = _decode(path, fields)
        folder.mkdir(parents=True, exist_ok=True)
        names = {topic: f"bag-{key}-{k}.parquet" for k, topic in enumerate(topics)}
        for topic, name in names.items():
            with whole(folder / name) as partial:
                topics[topic].to_parquet(partial)
        with whole(index) as partial:
            partial.write_text(json.dumps(names))
    return _merge(path, topics, request)


def _decode(path: Path, columns: Sequence[str]) -> dict[str, pd.DataFrame]:
    """Return the columns of each topic, with the time of each message as the index, s."""
    highlevel = optional("rosbags.highlevel", path)
    stores = optional("rosbags.typesys", path)
    # Old bags hold no definitions of their messages: the common ones are known.
    store = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    with highlevel.AnyReader([path], default_typestore=store) as reader:
        fields = _fields_of_topics(path, reader, columns)
        numbers = {topic: array("d") for topic in fields}
        connections = [item for item in reader.connections if item.topic in fields]
        for connection, stamp, raw in reader.messages(connections):
            message = reader.deserialize(raw, connection.msgtype)
            time = _time(message, stamp)
            place = f"{path}, topic {connection.topic}"
            numbers[connection.topic].append(time)
            numbers[connection.topic].extend(
                time if field == "t" else _number(message, field, place)
                for field in fields[connection.topic].values()
            )
    topics = {}
    for topic, names in fields.items():
        values = np.frombuffer(numbers[topic]).reshape(-1, 1 + len(names))
        frame = pd.DataFrame(values[:, 1:], index=values[:, 0], columns=list(names))
        if (empty := frame.isna().all()).any():
            field = names[empty.idxmax()]
            raise LogError(f"{path}, topic {topic}: no message has a value of {field!r}")
        topics[topic] = frame
    return topics


def _fields_of_topics(path: Path, reader: Any, columns: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return for each topic its columns and their fields in a message."""
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


def _number(message: Any, field: str, place: str) -> float:
    """Return the number at a path such as ``position/joint1``; NaN for an entry that is missing.

    Raises:
        LogError: if the message has no such field, or it is no number.
    """
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
            raise LogError(
                f"{place}: its messages have no {field!r}: their fields are {_fields(message)}"
            )
    if not isinstance(node, (int, float, np.number, np.bool_)):
        raise LogError(
            f"{place}: {field!r} is a {type(node).__name__}, expected a number: name an entry of "
            "it, or the column '<topic>/t' for the time"
        )
    return float(node)


def _fields(message: Any) -> str:
    return ", ".join(name for name in message.__dataclass_fields__ if not name.startswith("__"))


def _merge(path: Path, topics: dict[str, pd.DataFrame], request: Request) -> Table:
    """Return all columns at the times of the topic that has the time."""
    clock_topic = next(topic for topic, frame in topics.items() if request.time in frame)
    frame = topics[clock_topic].copy()
    usable = frame.notna().all(axis=1).to_numpy()
    notes = []
    if not usable.all():
        notes.append(f"{int((~usable).sum())} messages of {clock_topic} lack an entry")
    t = frame[request.time].to_numpy()
    frame.index = pd.RangeIndex(1, len(frame) + 1)
    for topic, messages in topics.items():
        if topic == clock_topic:
            continue
        messages = messages.dropna().sort_index(kind="stable")
        stamps = messages.index.to_numpy()
        last = np.searchsorted(stamps, t, side="right") - 1
        fresh = (last >= 0) & (t - stamps[last.clip(min=0)] <= request.max_age)
        if not fresh.all():
            notes.append(
                f"{int((~fresh).sum())} messages of {clock_topic} have none of {topic} in the "
                f"{request.max_age:g} s before them"
            )
        usable = usable & fresh
        for column in messages:
            frame[column] = messages[column].to_numpy()[last.clip(min=0)]
    if not usable.any():
        raise LogError(f"{path}: no row is left: {'; '.join(notes)}")
    dropped = int((~usable).sum())
    notes = [f"{dropped} rows are dropped: {note}" for note in notes]
    return Table(frame[usable], str(path), "message", notes=notes)
