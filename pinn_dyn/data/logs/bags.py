"""Bags of ROS 1 and ROS 2 and MCAP files as tables, without ROS.

A column is ``<topic>/<field>``, as ``/joint_states/position/panda_joint1`` or ``/commands/data/2``.
``<topic>/t`` is the time of a message, s: that of its header, or when the bag received it. The
topic of the time column has the rows. Of other topics a row takes the last message before it that
is not older than ``max_age``; rows without such a message are dropped.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pinn_dyn.data.cache import load_or_make
from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.messages import open_bag
from pinn_dyn.data.logs.table import Request, Table

# Names of the entries of arrays, in sensor_msgs, trajectory_msgs and control_msgs.
_NAMES = ("name", "joint_names", "interface_names")
_LATEST = 1.0  # s; a message that is later than this begins a new run


class _Topic(NamedTuple):
    """Values by the times of the messages, masks of missing entries, and who published them."""

    frame: pd.DataFrame
    missing: np.ndarray
    publishers: pd.Series


def read_bag(path: Path, request: Request) -> Table:
    """Read columns of a bag, one row per message of the topic of the time."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    stats = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    fields = list(dict.fromkeys(filter(None, [request.time, *request.columns])))
    description = [4, str(path.absolute()), stats, fields, request.max_age]

    def decode() -> dict[str, np.ndarray]:
        notes: list[str] = []
        topics = _decode(path, fields, request.max_age, notes)
        frame = _merge(path, topics, fields[0], request.max_age, notes)[fields]
        return {"rows": frame.index, "values": frame, "notes": np.array(notes, dtype=str)}

    folder = Path(os.environ.get("PINN_DYN_CACHE", "~/.cache/pinn_dyn")).expanduser()
    arrays = load_or_make(folder, "bag", description, decode)
    frame = pd.DataFrame(arrays["values"], arrays["rows"], fields)
    return Table(frame, str(path), "message", arrays["notes"].tolist())


def _decode(
    path: Path, columns: Sequence[str], max_age: float, notes: list[str]
) -> dict[str, _Topic]:
    """Return the values by topic; at times of receipt if these alone are of the same clock."""
    with open_bag(path) as bag:
        kinds = listed(f"{name} ({kind})" for name, kind in sorted(bag.topics.items()))
        fields = _fields_of_topics(path, sorted(bag.topics, key=len, reverse=True), columns, kinds)
        rows: dict[str, list[tuple[Any, ...]]] = {topic: [] for topic in fields}
        for topic, publisher, received, message in bag.messages(list(fields)):
            location = f"{path}, topic {topic}"
            values = [_number(message, field, location) for field in fields[topic].values()]
            names = getattr(message, "name", ())
            joints = tuple(map(str, names)) if hasattr(names, "__len__") else ()
            rows[topic].append((_stamp(message), 1e-9 * received, (publisher, joints), *values))
        notes += bag.notes
    content = {topic: np.array(x, dtype=object) for topic, x in rows.items()}
    if empty := [topic for topic, x in content.items() if not len(x)]:
        raise LogError(f"{path}: {listed(empty)} has no message, choose another of {kinds}")
    delays = {}
    for topic, (stamps, times) in {x: y[:, :2].astype(float).T for x, y in content.items()}.items():
        if (stamps > 0).any():
            delays[topic] = float(np.median((times - stamps)[stamps > 0]))
    far = [topic for topic, delay in delays.items() if abs(delay) > max_age]
    if far and len(delays) < len(content):
        notes.append(f"stamps of {listed(far)} are off by {delays[far[0]]:.4g} s: times of receipt")
        for topic in delays:
            content[topic][:, 0] = None
    return {
        topic: _topic(path, topic, list(names), content[topic], kinds, notes)
        for topic, names in fields.items()
    }


def _topic(
    path: Path, topic: str, columns: list[str], rows: np.ndarray, kinds: str, notes: list[str]
) -> _Topic:
    """Return the values of a topic in the order of the times of its messages."""
    stamps, times = rows[:, :2].astype(float).T
    if (stamps > 0).any():
        # In a simulation 0 is the first time.
        zero = (stamps == 0) & (stamps[stamps > 0].min() > _LATEST)
        if zero.any():
            text = f"{zero.sum()} of {len(rows)} messages of {topic} with stamp 0 are dropped"
            notes.append(text)
        rows, times = rows[~zero], np.where(np.isnan(stamps), times, stamps)[~zero]
    elif (stamps == 0).any():
        notes.append(f"the stamps of {topic} are 0: its times are those of receipt")
    delay = np.maximum.accumulate(times) - times
    if 0 < delay.max() < _LATEST:
        notes.append(f"{(delay > 0).sum()} messages of {topic} came late: sorted by their times")
        order = times.argsort(kind="stable")
        rows, times = rows[order], times[order]
    content = rows[:, 3:]
    if f"{topic}/t" in columns and content[0, columns.index(f"{topic}/t")] is None:
        content[:, columns.index(f"{topic}/t")] = times
    missing = np.array(content == None)  # noqa: E711
    complete = rows[~missing.any(axis=1), 2]
    values = content.astype(float)
    for column, absent, numbers in zip(columns, missing.T, values.T, strict=True):
        if absent.all():
            joints = sorted({name for _, names in rows[:, 2] for name in names})
            short = column.rpartition("/")[2] in joints or not joints
            reason = "its array is shorter" if short else f"the messages name {listed(joints)}"
            raise LogError(f"{path}: no message has a value of {column!r}: {reason}")
        if np.isnan(numbers).all():
            raise LogError(
                f"{path}: {column!r} is NaN in all {len(rows)} messages: the driver does not "
                f"measure it. Choose another signal, such as commands; the bag has {kinds}"
            )
        k = column.rpartition("/")[2]
        if k.isdigit() and len(mixed := {x[int(k)] for _, x in complete if int(k) < len(x)}) > 1:
            turns = f"is of {listed(sorted(mixed))} by turns"
            raise LogError(f"{path}: {column!r} {turns}: write {column[: -len(k)]}{min(mixed)}")
    frame = pd.DataFrame(values, columns=columns, index=times)
    return _Topic(frame, np.any(missing, axis=1), pd.Series(rows[:, 2]))


def _fields_of_topics(
    path: Path, topics: Sequence[str], columns: Sequence[str], kinds: str
) -> dict[str, dict[str, str]]:
    """Return the field of each column by its topic; the longest topic that fits."""
    fields: dict[str, dict[str, str]] = {}
    for column in columns:
        topic = next((name for name in topics if column.startswith(f"{name}/")), None)
        if topic is None:
            raise LogError(f"{path}: no topic for the column {column!r}: the bag has {kinds}")
        fields.setdefault(topic, {})[column] = column[len(topic) + 1 :]
    return fields


def _seconds(time: Any) -> float | None:
    """Return a time or duration of ROS, JSON or protobuf in s; None for other objects."""
    for seconds, fraction in (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos")):
        if hasattr(time, seconds) and hasattr(time, fraction):
            return 1e-9 * (10**9 * getattr(time, seconds) + getattr(time, fraction))
    return None


def _stamp(message: Any) -> float | None:
    """Return the time of a message, s, from its header or ``timestamp``; None without."""
    header = getattr(message, "header", None)
    return _seconds(getattr(header, "stamp", getattr(message, "timestamp", None)))


def _number(message: Any, field: str, location: str) -> float | None:
    """Return the number at a path such as ``position/joint1``; None for a missing entry."""
    if field == "t" and not hasattr(message, "t"):
        return None  # the time of the message follows
    node = message
    parents: list[Any] = []
    for step in field.split("/"):
        parents.insert(0, node)
        if hasattr(node, "__len__") and not isinstance(node, str):
            k = int(step) if step.isdigit() else _index(step, node, parents)
            if k >= len(node):
                return None
            node = node[k]
        elif hasattr(node, step):
            node = getattr(node, step)
        else:
            paths = listed(path[1:] for path in _paths(message))
            raise LogError(f"{location}: no {field!r} in its messages, which have {paths}")
    if node is None:  # of JSON
        return None
    seconds = _seconds(node)
    if seconds is None and not isinstance(node, (int, float, np.number, np.bool_)):
        kind = type(node).__name__
        raise LogError(f"{location}: {field!r} is a {kind}, expected a number, or '<topic>/t'")
    return float(node) if seconds is None else seconds


def _index(name: str, node: Any, parents: Sequence[Any]) -> int:
    """Return the position of a name among those beside an array or in its elements."""
    return next((list(x).index(name) for x in _names(node, parents) if name in x), len(node))


def _names(node: Any, parents: Sequence[Any]) -> list[Any]:
    lists = [getattr(parent, x) for parent in parents for x in _NAMES if hasattr(parent, x)]
    return [*lists, [getattr(element, "name", None) for element in node]]


def _paths(node: Any, parents: Sequence[Any] = ()) -> list[str]:
    """Return the paths of the numbers of a message, with the names of entries."""
    if isinstance(node, (int, float, np.number)):
        return [""]
    if isinstance(node, (str, bytes)) or callable(node) or _seconds(node) is not None:
        return []
    if hasattr(node, "__len__"):
        named = (x for x in _names(node, parents) if len(x) == len(node) and None not in x)
        parts = dict(zip(next(named, range(len(node))), node, strict=True))
    else:
        parts = {x: getattr(node, x) for x in dir(node) if x[0] != "_" and x != "DESCRIPTOR"}
    return [f"/{x}{y}" for x, part in parts.items() for y in _paths(part, [node, *parents])]


def _merge(
    path: Path, topics: dict[str, _Topic], first: str, max_age: float, notes: list[str]
) -> pd.DataFrame:
    """Return the rows of the topic of the first column, with the last values of other topics."""
    clock = next(name for name, topic in topics.items() if first in topic.frame)
    frame, missing, publishers = topics.pop(clock)
    times, nodes = frame.index, publishers.str[0]
    joints = {name for _, names in publishers[missing] for name in names}
    joints -= {name for _, names in publishers[~missing] for name in names}
    lack = f"lack an entry, being of {listed(sorted(joints))}," if joints else "lack an entry"
    frame.index = pd.RangeIndex(1, len(frame) + 1)
    faults = {
        lack: missing,
        "are of another publisher": ~nodes.isin(nodes[~missing].mode()[:1]),
        "are NaN": frame.isna().any(axis=1),
    }
    for topic in topics.values():
        messages = topic.frame.dropna().sort_index(kind="stable")
        messages = messages[~messages.index.duplicated(keep="last")]
        latest = messages.reindex(times, method="ffill", tolerance=max_age)
        frame[messages.columns] = latest.to_numpy()
    age = f"have no message of {listed(topics)} in the {max_age:g} s before them"
    faults[age] = frame.isna().any(axis=1)
    reasons = np.select([*faults.values()], [*faults], "")
    if dropped := Counter(reasons[reasons != ""].tolist()):
        text = ", ".join(f"{count} {reason}" for reason, count in dropped.items())
        text = f"{dropped.total()} of {len(frame)} messages of {clock} are dropped: {text}"
        if dropped.total() == len(frame):
            raise LogError(f"{path}: no row is left: {text}")
        notes.append(text)
    return frame[reasons == ""]
