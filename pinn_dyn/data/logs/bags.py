"""Bags of ROS 1 and ROS 2, MCAP included, as a table; read by rosbags, without ROS.

A column is ``<topic>/<field>``, as ``/joint_states/position/panda_joint1``: an entry of an array is
picked by the joint's name, where the message has names, or by its number from 0, as in
``/commands/data/2``. ``<topic>/t`` is the time of a message, s: that of its header, or where it has
none, when the bag received it.

The topic of the time column has the rows. Of every other topic a row takes the last message that is
not later than it, and not older than ``max_age``; rows without one are dropped.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.messages import BATCH, Topic

BAG_SUFFIXES = (".bag", ".mcap", ".db3")


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a file, or the folder that ROS 2 writes."""
    return path.suffix in BAG_SUFFIXES or (path / "metadata.yaml").is_file()


def optional(name: str, path: Path) -> Any:
    """A module of the extra ``logs``.

    Raises:
        LogError: if it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise LogError(
            f"{path}: to read it takes the package {name.split('.')[0]}, which is not installed: "
            "pip install 'pinn_dyn[logs]'"
        ) from error


def read_bag(path: Path, time: str, columns: Sequence[str], max_age: float) -> pd.DataFrame:
    """The columns asked for, one row per message of the topic of the time.

    Args:
        path: the bag.
        time: column of the time.
        columns: all columns to read, the time among them or not.
        max_age: how old a message of another topic may be, s.

    Raises:
        LogError: on a bag that is damaged, topics, fields or joints that it does not have, and
            clocks that never overlap.
    """
    highlevel = optional("rosbags.highlevel", path)
    stores = optional("rosbags.typesys", path)
    try:
        # Old bags hold no definitions of their messages: the common ones are known.
        known = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
        with highlevel.AnyReader([path], default_typestore=known) as reader:
            topics = _read(reader, path, [time, *columns])
    except LogError:
        raise
    except Exception as error:  # rosbags and its codecs raise nearly anything on damaged bytes
        raise LogError(
            f"{path}: cannot be read as a bag, it may be cut short, or be compressed by a codec "
            f"that is missing ({type(error).__name__}: {error}): try 'ros2 bag reindex', or "
            "'rosbag reindex' for ROS 1, write it without compression ('ros2 bag convert'), or "
            "record it again"
        ) from error
    return _merged(path, topics, time, max_age)


def _read(reader: Any, path: Path, columns: Sequence[str]) -> dict[str, Topic]:
    """The topics that columns are asked of."""
    topics = sorted(reader.topics, key=len, reverse=True)
    fields: dict[str, dict[str, str]] = {}
    for column in dict.fromkeys(columns):
        topic = next((name for name in topics if column.startswith(f"{name}/")), None)
        if topic is None:
            there = listed(
                f"{name} ({info.msgtype})" for name, info in sorted(reader.topics.items())
            )
            raise LogError(f"{path}: no topic for the column {column!r}: the bag has {there}")
        fields.setdefault(topic, {})[column] = column[len(topic) + 1 :]
    for connection in reader.connections:
        if connection.topic in fields and connection.msgtype not in reader.typestore.types:
            raise LogError(
                f"{path}, topic {connection.topic}: its type {connection.msgtype} is unknown and "
                "the bag has no definition of it: record the bag as MCAP, which keeps definitions"
            )
    wanted = [c for c in reader.connections if c.topic in fields]
    taken = {
        topic: Topic(
            f"{path}, topic {topic}", asked, sum(c.msgcount for c in wanted if c.topic == topic)
        )
        for topic, asked in fields.items()
    }
    waiting: dict[tuple[str, str], tuple[list[bytes], list[int]]] = {}
    for connection, stamp, raw in reader.messages(wanted):
        key = connection.topic, connection.msgtype
        raws, stamps = waiting.setdefault(key, ([], []))
        raws.append(raw)
        stamps.append(stamp)
        if len(raws) == BATCH:
            taken[connection.topic].add(raws, stamps, connection.msgtype, reader)
            del waiting[key]
    for (topic, kind), (raws, stamps) in waiting.items():
        taken[topic].add(raws, stamps, kind, reader)
    for topic, found in taken.items():
        if not found.rows:
            raise LogError(f"{path}, topic {topic}: has no messages")
        for field, column in zip(fields[topic].values(), found.values, strict=True):
            if np.isnan(column).all():
                array, most = found.arrays.get(field, (field, 0))
                there = f"{array!r} has {most} entries at most, which count from 0"
                if found.names and most:
                    there = f"its joints are {listed(sorted(found.names))}"
                raise LogError(
                    f"{path}, topic {topic}: no message has a value of {field!r}: "
                    f"{there if most else f'{array!r} is empty in all of them'}"
                )
    return taken


def _merged(
    path: Path,
    topics: dict[str, Topic],
    time: str,
    max_age: float,
) -> pd.DataFrame:
    """All columns at the times of the topic that has the time."""
    clock_topic = next(topic for topic, found in topics.items() if time in found.fields)
    own = _table(topics[clock_topic])
    kept = own.notna().all(axis=1).to_numpy()
    notes = []
    if not kept.all():
        notes.append(f"{int((~kept).sum())} messages of {clock_topic} lack a joint asked for")
    t = own[time].to_numpy()
    table = own
    for topic, found in topics.items():
        if topic == clock_topic:
            continue
        other = _table(found)
        whole = other.notna().all(axis=1).to_numpy()
        order = np.argsort(found.times[whole], kind="stable")
        s, other = found.times[whole][order], other[whole].iloc[order]
        if not len(s) or s[-1] < t.min() - max_age or s[0] > t.max():
            raise LogError(
                f"{path}: the clocks of {clock_topic} and {topic} never overlap: {t.min():.6f} to "
                f"{t.max():.6f} s, and {s[:1]} to {s[-1:]} s: does one of them stamp by the time "
                "of the simulation?"
            )
        last = np.searchsorted(s, t, side="right") - 1
        fresh = (last >= 0) & (t - s[last.clip(min=0)] <= max_age)
        if not fresh.all():
            notes.append(
                f"{int((~fresh).sum())} messages of {clock_topic} have none of {topic} in the "
                f"{max_age:g} s before them"
            )
        kept = kept & fresh
        for column in other:
            table[column] = other[column].to_numpy()[last.clip(min=0)]
    if not kept.any():
        raise LogError(f"{path}: no row is left: {'; '.join(notes)}")
    table.index = pd.RangeIndex(1, len(table) + 1)
    if kept.all():
        return table
    whole_table = len(table)
    table = table[kept]
    table.attrs["notes"] = [f"{whole_table - len(table)} rows are dropped: {x}" for x in notes]
    return table


def _table(topic: Topic) -> pd.DataFrame:
    """Its columns, not copied: logs are large."""
    return pd.DataFrame(topic.values.T, columns=list(topic.fields), copy=False)
