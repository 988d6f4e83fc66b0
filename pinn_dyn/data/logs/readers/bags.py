"""Read bags of ROS 1 and ROS 2 and MCAP files as tables, without ROS.

A column is ``<topic>/<field>``, as ``/joint_states/position/panda_joint1`` or ``/commands/data/2``.
``<topic>/t`` is the time of a message in s, from its header, or otherwise the time of receipt. A
row is a message of a single topic. The columns of all other topics have empty cells.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pinn_dyn.data.cache import load_or_make
from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.readers.messages import open_bag
from pinn_dyn.data.logs.table import Request, Table, alternates

# Names of the entries of arrays, in sensor_msgs, trajectory_msgs and control_msgs.
_NAMES = ("name", "joint_names", "interface_names")
_LATEST = 1.0  # longest step back in time within a run, s
_REGULAR = 0.05  # largest share of early messages of a single publisher
_FEW = 20  # smallest number of messages that distinguishes two publishers
_RECEIVED = ""  # column of the times of receipt


def read_bag(path: Path, request: Request) -> Table:
    """Read columns of a bag, with a row per message."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    stats = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    fields = list(dict.fromkeys(filter(None, [request.time, *request.columns])))
    description = [7, str(path.absolute()), stats, fields, request.max_age]

    def decode() -> dict[str, np.ndarray]:
        notes: list[str] = []
        frame = _merged(_decode(path, fields, request.max_age, notes), fields[0])
        clock = frame[fields[0]]
        if not request.time:  # the rows of the first topic, with the last values of others
            frame = frame.ffill().where(clock.notna())
        elif (clock.isna() | (clock == frame.index)).all():
            frame[fields[0]] = frame.index
        else:  # a message of another topic has the time of the next row of the clock
            frame[fields[0]] = clock.bfill()
        frame = frame.dropna(subset=fields[:1])[fields]
        return {"values": frame.to_numpy(), "notes": np.array(notes, dtype=str)}

    folder = Path(os.environ.get("PINN_DYN_CACHE", "~/.cache/pinn_dyn")).expanduser()
    arrays = load_or_make(folder, "bag", description, decode)
    frame = pd.DataFrame(arrays["values"], columns=fields)
    return Table(frame.set_axis(frame.index + 1), str(path), "message", arrays["notes"].tolist())


def _decode(
    path: Path, columns: Sequence[str], max_age: float, notes: list[str]
) -> list[pd.DataFrame]:
    """Return the values of each topic, on the clock of the first topic if the clocks differ."""
    with open_bag(path) as bag:
        kinds = listed(f"{name} ({kind})" for name, kind in sorted(bag.topics.items()))
        fields = _fields_of_topics(path, sorted(bag.topics, key=len, reverse=True), columns, kinds)
        rows: dict[str, list[tuple[Any, ...]]] = {topic: [] for topic in fields}
        for topic, publisher, received, message in bag.messages(list(fields)):
            location = f"{path}, topic {topic}"
            values = [_number(message, field, location) for field in fields[topic].values()]
            names = getattr(message, "name", ())
            joints = tuple(map(str, names)) if hasattr(names, "__len__") else ()
            rows[topic].append((_stamp(message), 1e-9 * received, publisher, joints, *values))
        notes += bag.notes
    if empty := [topic for topic, x in rows.items() if not x]:
        raise LogError(f"{path}: {listed(empty)} has no message, choose another of {kinds}")
    delays = {}
    for topic, content in rows.items():
        stamps, times = np.array([row[:2] for row in content], dtype=float).T
        delays[topic] = float(np.median((times - stamps)[stamps > 0])) if (stamps > 0).any() else 0
    tables = {topic: np.array(x, dtype=object) for topic, x in rows.items()}
    if max(delays.values()) - min(delays.values()) > max_age:
        first = next(iter(tables))
        clock = tables[first][np.argsort(tables[first][:, 1]), :2].astype(float)
        clock = clock[clock[:, 0] > 0] if delays[first] else clock[:, [1, 1]]
        for topic in list(tables)[1:]:
            times = tables[topic][:, 1].astype(float)
            inside = times.clip(*clock[[0, -1], 1])
            tables[topic][:, 0] = np.interp(inside, clock[:, 1], clock[:, 0]) + times - inside
            notes.append(f"times of receipt put {topic} on the clock of {first}")
    return [_topic(path, x, list(fields[x]), table, kinds, notes) for x, table in tables.items()]


def _topic(
    path: Path, topic: str, columns: list[str], rows: np.ndarray, kinds: str, notes: list[str]
) -> pd.DataFrame:
    """Return the values of a topic by the times of its messages, and the times of receipt."""
    stamps, received = rows[:, :2].astype(float).T
    # Stamps 0 are missing stamps, except in a simulation, where 0 is the first time.
    zero = (stamps == 0) & (stamps[stamps > 0].min(initial=np.inf) > _LATEST)
    if zero.all():
        notes.append(f"the stamps of {topic} are 0: its times are those of receipt")
        stamps, zero = np.full(len(rows), np.nan), ~zero
    times = np.where(np.isnan(stamps), received, stamps)
    publishers, joints, content = rows[:, 2].astype(int), rows[:, 3], rows[:, 4:]
    signals = [k for k, column in enumerate(columns) if column != f"{topic}/t"]
    if len(signals) < len(columns) and content[0, columns.index(f"{topic}/t")] is None:
        content[:, columns.index(f"{topic}/t")] = times
    missing = np.array(content == None)  # noqa: E711
    foreign = missing[:, signals].all(axis=1) & (len(signals) > 0)
    values = content.astype(float)
    for k, column in enumerate(columns):
        field = column.rpartition("/")[2]
        names = [{*x} for x in joints]
        if field.isdigit():
            names = [{*x[int(field) : int(field) + 1]} for x in joints[~foreign]]
        joined = sorted(set().union(*names))
        if missing[:, k].all():
            short = field in joined or not joined
            reason = "its array is shorter" if short else f"the messages name {listed(joined)}"
            raise LogError(f"{path}: no message has a value of {column!r}: {reason}")
        if np.isnan(values[:, k]).all():
            raise LogError(
                f"{path}: {column!r} is NaN in all {len(rows)} messages: the driver does not "
                f"measure it. Choose another signal, such as commands; the bag has {kinds}"
            )
        if field.isdigit() and len(joined) > 1:
            name = f"{column[: -len(field)]}{joined[0]}"
            raise LogError(f"{path}: {column!r} belongs to {listed(joined)} by turns: write {name}")
    publishers, orders = _publishers(publishers, joints, times)
    usual = pd.Series(publishers[~foreign]).mode()[0]
    for reason, mask in (
        ("with stamp 0", zero),
        (f"of {listed(sorted(set().union(*joints[foreign])))}", foreign),
        (f"of another publisher{orders}", ~foreign & (publishers != usual)),
    ):
        if mask.any():
            notes.append(f"{mask.sum()} of {len(rows)} messages of {topic} {reason} are dropped")
    stays = ~zero & ~foreign & (publishers == usual)
    frame = pd.DataFrame(values, times, columns).assign(**{_RECEIVED: received})[stays]
    for name in (columns[k] for k in signals if len(frame) > _FEW):
        measured = {"position", "velocity"} & set(name.split("/"))  # commands may alternate
        if measured and alternates(frame[name].to_numpy()):
            raise LogError(
                f"{path}: {name!r} alternates from message to message: two nodes publish {topic}, "
                "and the bag does not record which. Stop or remap a node, and record again"
            )
    return frame


def _publishers(
    publishers: np.ndarray, joints: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, str]:
    """Return the number of the publisher of each message, and a note on the orders of joints.

    Nodes with the same connection are distinguished by the order of their joints, if messages with
    the same order come at regular times, and all messages together do not.
    """
    orders = list(dict.fromkeys(x for x in joints if x))
    numbers = np.array([orders.index(x) if x else 0 for x in joints])
    counts = np.bincount(numbers)
    if len({frozenset(x) for x in orders}) != 1 or len(orders) < 2 or counts.min() < _FEW:
        return publishers, ""
    irregular = [_early(times[mask]) for mask in (numbers >= 0, numbers == counts.argmax())]
    if irregular[0] < _REGULAR or irregular[1] > _REGULAR:
        return publishers, ""
    texts = [f"{count} of {', '.join(x)}" for x, count in zip(orders, counts, strict=True)]
    return publishers * len(orders) + numbers, f" ({' and '.join(texts)})"


def _early(times: np.ndarray) -> float:
    """Return the share of messages that come within half of the usual time."""
    spacing = np.diff(np.sort(times))
    return float((spacing < np.median(spacing) / 2).mean())


def _merged(topics: Sequence[pd.DataFrame], last: str) -> pd.DataFrame:
    """Sort all rows by their times in each run. At equal times, rows with ``last`` come last."""
    frame = pd.concat(topics).sort_values(_RECEIVED, kind="stable")
    run = np.cumsum(np.diff(frame.index, prepend=frame.index[0]) < -_LATEST)
    return frame.iloc[np.lexsort((frame[last].notna(), frame.index, run))]


def _fields_of_topics(
    path: Path, topics: Sequence[str], columns: Sequence[str], kinds: str
) -> dict[str, dict[str, str]]:
    """Return the field of each column, by topic. The topic is the longest match."""
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
    """Return the time of a message, s, from its header or ``timestamp``, or None."""
    header = getattr(message, "header", None)
    return _seconds(getattr(header, "stamp", getattr(message, "timestamp", None)))


def _number(message: Any, field: str, location: str) -> float | None:
    """Return the number at a path such as ``position/joint1``; None for a missing entry."""
    if field == "t" and not hasattr(message, "t"):
        return None  # the time of the message follows
    node = message
    parents: list[Any] = []
    name = ""
    for step in field.split("/"):
        name = f"{name}/{step}".lstrip("/")  # names of joints may have slashes
        parents.insert(0, node)
        if hasattr(node, "__len__") and not isinstance(node, str):
            k = int(name) if name.isdigit() else _index(name, node, parents)
            if k >= len(node):
                continue
            node = node[k]
        elif hasattr(node, name):
            node = getattr(node, name)
        else:
            paths = listed(path[1:] for path in _paths(message))
            raise LogError(f"{location}: no {field!r} in its messages, which have {paths}")
        name = ""
    if name or node is None:  # null of JSON
        return None
    seconds = _seconds(node)
    if seconds is None and not isinstance(node, (int, float, np.number, np.bool_)):
        kind = type(node).__name__
        raise LogError(f"{location}: {field!r} is a {kind}, expected a number, or '<topic>/t'")
    return float(node) if seconds is None else seconds


def _index(name: str, node: Any, parents: Sequence[Any]) -> int:
    """Return the index of a name in the names beside an array or in its elements."""
    return next((list(x).index(name) for x in _names(node, parents) if name in x), len(node))


def _names(node: Any, parents: Sequence[Any]) -> list[Any]:
    lists = [getattr(parent, x) for parent in parents for x in _NAMES if hasattr(parent, x)]
    return [*lists, [getattr(element, "name", None) for element in node]]


def _paths(node: Any, parents: Sequence[Any] = ()) -> list[str]:
    """Return the paths of all numbers in a message, with the names of entries."""
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
