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
from array import array
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pinn_dyn.data.logs.errors import LogError

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
# Names of the entries of a message's arrays, in sensor_msgs and trajectory_msgs.
_NAMES = ("name", "joint_names")
_NAN = float("nan")


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
            times, arrays = _read(reader, path, [time, *columns])
    except LogError:
        raise
    except Exception as error:  # rosbags and its codecs raise nearly anything on damaged bytes
        raise LogError(
            f"{path}: cannot be read as a bag, it may be cut short, or be compressed by a codec "
            f"that is missing ({type(error).__name__}: {error}): try 'ros2 bag reindex', or "
            "'rosbag reindex' for ROS 1, or record it again"
        ) from error
    return _merged(path, times, arrays, time, max_age)


def _read(
    reader: Any, path: Path, columns: Sequence[str]
) -> tuple[dict[str, np.ndarray], dict[str, dict[str, np.ndarray]]]:
    """Times of each topic asked for, and its columns."""
    topics = sorted(reader.topics, key=len, reverse=True)
    fields: dict[str, dict[str, str]] = {}
    for column in dict.fromkeys(columns):
        topic = next((name for name in topics if column.startswith(f"{name}/")), None)
        if topic is None:
            there = ", ".join(
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
    times = {topic: array("d") for topic in fields}
    values = {topic: {column: array("d") for column in fields[topic]} for topic in fields}
    seen: dict[str, set[str]] = {topic: set() for topic in fields}
    getters: dict[str, list[tuple[array, Callable[[Any], float]]]] = {}
    for connection, stamp, raw in reader.messages(wanted):
        topic = connection.topic
        message = reader.deserialize(raw, connection.msgtype)
        if topic not in getters:
            getters[topic] = [
                (values[topic][column], _getter(message, field, f"{path}, topic {topic}"))
                for column, field in fields[topic].items()
                if field != "t"
            ]
        times[topic].append(_time(message, stamp))
        for name in _NAMES:
            seen[topic].update(getattr(message, name, ()))
        for store, get in getters[topic]:
            store.append(get(message))
    arrays: dict[str, dict[str, np.ndarray]] = {}
    for topic, stores in values.items():
        if not len(times[topic]):
            raise LogError(f"{path}, topic {topic}: has no messages")
        arrays[topic] = {}
        for column, field in fields[topic].items():
            x = np.asarray(times[topic] if field == "t" else stores[column], dtype=float)
            if np.isnan(x).all():
                names = f"its joints are {', '.join(sorted(seen[topic]))}" if seen[topic] else ""
                raise LogError(
                    f"{path}, topic {topic}: no message has a value of {field!r}: "
                    f"{names or 'the array is empty or shorter in all of them'}"
                )
            arrays[topic][column] = x
    return {topic: np.asarray(t) for topic, t in times.items()}, arrays


def _time(message: Any, stamp: int) -> float:
    header = getattr(message, "header", None)
    if header is not None and (header.stamp.sec or header.stamp.nanosec):
        stamp = 10**9 * header.stamp.sec + header.stamp.nanosec  # rounded once, as the other is
    return 1e-9 * stamp


def _getter(message: Any, field: str, place: str) -> Callable[[Any], float]:
    """What takes the number at a path such as ``position/joint1`` out of a message, or NaN."""
    *inner, last = field.split("/")
    names = next((name for name in _NAMES if hasattr(message, name)), None)
    at = message
    for step in inner:
        if step.isdigit():
            at = at[int(step)] if int(step) < len(at) else None
        else:
            at = getattr(at, step, None)
        if at is None:
            raise LogError(
                f"{place}: its messages have no {field!r}: their fields are "
                f"{', '.join(_fields(message))}"
            )
    if not inner and not hasattr(message, last):
        raise LogError(
            f"{place}: its messages have no {field!r}: their fields are "
            f"{', '.join(_fields(message))}"
        )

    def get(one: Any) -> float:
        x = one
        for step in inner:
            if step.isdigit():
                if int(step) >= len(x):
                    return _NAN
                x = x[int(step)]
            else:
                x = getattr(x, step)
        if hasattr(x, "__len__"):
            if last.isdigit():
                k = int(last)
            else:
                every = getattr(one, names) if names else ()
                k = every.index(last) if last in every else len(x)
            return float(x[k]) if k < len(x) else _NAN
        x = getattr(x, last)
        return _NAN if hasattr(x, "__len__") else float(x)

    return get


def _fields(message: Any) -> list[str]:
    return [name for name in message.__dataclass_fields__ if not name.startswith("__")]


def _merged(
    path: Path,
    times: dict[str, np.ndarray],
    arrays: dict[str, dict[str, np.ndarray]],
    time: str,
    max_age: float,
) -> pd.DataFrame:
    """All columns at the times of the topic that has the time."""
    clock_topic = next(topic for topic, columns in arrays.items() if time in columns)
    own = pd.DataFrame(arrays[clock_topic])
    kept = own.notna().all(axis=1).to_numpy()
    notes = []
    if not kept.all():
        notes.append(f"{int((~kept).sum())} messages of {clock_topic} lack a joint asked for")
    t = arrays[clock_topic][time]
    table = own
    for topic, columns in arrays.items():
        if topic == clock_topic:
            continue
        other = pd.DataFrame(columns)
        whole = other.notna().all(axis=1).to_numpy()
        order = np.argsort(times[topic][whole], kind="stable")
        s, other = times[topic][whole][order], other[whole].iloc[order]
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
    table = table[kept]
    table.attrs["notes"] = [f"{len(own) - len(table)} rows are dropped: {x}" for x in notes]
    return table
