"""Numbers out of serialized messages of ROS: thousands at once where their layout is the same.

Deserializing a message takes some 20 us in Python, a log of an hour has millions. But the messages
of a topic nearly always have one layout: the same joints, so the same lengths and texts at the same
bytes, and only the numbers differ. The layout is found from the definition of the type, checked
against the deserialized message, and the numbers of all messages of that layout are then read as
columns of one array. Messages of another layout make one of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pinn_dyn.data.logs.errors import LogError

BATCH = 4096  # messages that are looked at together
_LAYOUTS = 64  # of a topic, at most; other messages are deserialized one by one
# Names of the entries of a message's arrays, in sensor_msgs and trajectory_msgs.
_NAMES = ("name", "joint_names")
_NAN = float("nan")
_TYPES = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "octet": "u1",
    **{
        f"{sign}int{8 * size}": f"<{sign or 'i'}{size}"
        for sign in ("", "u")
        for size in (1, 2, 4, 8)
    },
    "float32": "<f4",
    "float64": "<f8",
}
_STAMP = ("header/stamp/sec", "header/stamp/nanosec")

Get = Callable[[Any], float]
"""Takes the number of a column out of a deserialized message, or NaN."""


@dataclass
class Layout:
    """Where the numbers and the texts of a message are.

    Attributes:
        size: of the message, bytes.
        numbers: path to first byte, type and count; a count of None is a single number.
        texts: path to a text or texts.
        fixed: places of the bytes that messages of this layout share, lengths and texts.
        shared: these bytes.
    """

    size: int
    numbers: dict[str, tuple[int, np.dtype[Any], int | None]] = field(default_factory=dict)
    texts: dict[str, list[str]] = field(default_factory=dict)
    fixed: list[int] = field(default_factory=list)
    shared: np.ndarray = field(default_factory=lambda: np.zeros(0, np.uint8))

    def place(self, path: str) -> tuple[int, np.dtype[Any]] | None:
        """First byte and type of the number at a path such as ``position/joint1``, or None."""
        inner, _, last = path.rpartition("/")
        first, kind, count = self.numbers.get(inner, (0, np.dtype("u1"), None))
        if count is not None:
            names = next((self.texts[name] for name in _NAMES if name in self.texts), [])
            k = int(last) if last.isdigit() else names.index(last) if last in names else count
            return (first + k * kind.itemsize, kind) if k < count else None
        first, kind, count = self.numbers.get(path, (0, kind, 0))
        return (first, kind) if count is None else None


def layout_of(raw: bytes, kind: str, definitions: Any, *, cdr: bool) -> Layout | None:
    """The layout of a message of a type, or None where its definition or its bytes are unusual.

    Args:
        raw: the message, as CDR (ROS 2) or as ROS 1 writes it.
        kind: its type.
        definitions: type to its fields, as rosbags has them.
        cdr: whether it is CDR.
    """
    if cdr and raw[:2] != b"\x00\x01":  # little-endian, plain
        return None
    walk = _Walk(raw, definitions, cdr)
    try:
        walk.message(kind, "")
    except (KeyError, IndexError, ValueError, UnicodeDecodeError):
        return None
    if walk.at > len(raw):
        return None
    walk.found.shared = np.frombuffer(raw, np.uint8)[walk.found.fixed]
    return walk.found


class _Walk:
    """Goes through the bytes of a message along the definition of its type."""

    def __init__(self, raw: bytes, definitions: Any, cdr: bool):
        self.raw, self.definitions, self.cdr = raw, definitions, cdr
        self.at = 4 if cdr else 0
        self.found = Layout(len(raw))

    def message(self, kind: str, prefix: str) -> None:
        for name, (node, content) in self.definitions[kind][1]:
            self.field(prefix + name, node.name, content)

    def field(self, path: str, node: str, content: Any) -> None:
        if node == "NAME":
            self.message(content, f"{path}/")
        elif node == "BASE":
            self.base(path, content[0], None)
        else:
            (inner, what), count = content
            if node == "SEQUENCE":
                count = self.length()
            if inner.name == "BASE":
                self.base(path, what[0], count)
            else:
                for k in range(count):
                    self.field(f"{path}/{k}", inner.name, what)

    def base(self, path: str, name: str, count: int | None) -> None:
        if name == "string":
            texts = [self.text() for _ in range(1 if count is None else count)]
            self.found.texts[path] = texts
            return
        kind = np.dtype(_TYPES[name])
        if count != 0:
            self.align(kind.itemsize)
        self.found.numbers[path] = self.at, kind, count
        self.at += kind.itemsize * (1 if count is None else count)

    def text(self) -> str:
        size = self.length()
        self.keep(size)
        return self.raw[self.at - size : self.at].rstrip(b"\0").decode()

    def length(self) -> int:
        self.align(4)
        self.keep(4)
        size = int.from_bytes(self.raw[self.at - 4 : self.at], "little")
        if size > len(self.raw):
            raise ValueError("a length beyond the end")
        return size

    def keep(self, size: int) -> None:
        self.found.fixed.extend(range(self.at, self.at + size))
        self.at += size

    def align(self, size: int) -> None:
        if self.cdr:  # counted from behind its four bytes of a header
            self.at += -(self.at - 4) % size


class Topic:
    """The columns of a topic, filled message by message.

    Args:
        place: file and topic, for messages of errors.
        fields: column to its path in a message; ``t`` is the time.
        count: messages that are expected.

    Attributes:
        rows: messages so far.
        names: of the entries of arrays in all of them.
        arrays: of a path that leads into an array, the path of the array and its most entries.
    """

    def __init__(self, place: str, fields: dict[str, str], count: int):
        self.place, self.fields = place, fields
        self.rows = 0
        self.names: set[str] = set()
        self.arrays: dict[str, tuple[str, int]] = {}
        self._data = np.empty((1 + len(fields), count))  # the time, then the columns
        self._getters: list[Get] = []
        self._layouts: list[Layout] = []

    @property
    def times(self) -> np.ndarray:
        """Of the messages, ``(T,)``, s."""
        return self._data[0, : self.rows]

    @property
    def values(self) -> np.ndarray:
        """The columns, ``(C, T)``."""
        return self._data[1:, : self.rows]

    def add(self, raws: Sequence[bytes], stamps: Sequence[int], kind: str, reader: Any) -> None:
        """Take in messages of one type, with the times in ns at which the bag received them.

        Raises:
            LogError: on a field that the messages do not have.
        """
        if not self._getters:
            first = reader.deserialize(raws[0], kind)
            self._getters = [
                _getter(first, path, self.place, self.arrays)
                for path in self.fields.values()
                if path != "t"
            ]
        begin, self.rows = self.rows, self.rows + len(raws)
        if self.rows > self._data.shape[1]:  # the bag's own count was wrong
            more = np.empty((len(self._data), self.rows))
            self._data = np.concatenate([self._data[:, :begin], more], axis=1)
        into = self._data[:, begin : self.rows]
        received, left = np.asarray(stamps, dtype=np.int64), np.arange(len(raws))
        for layout in self._layouts:
            left = self._take(layout, raws, received, left, into)
        while len(left) and len(self._layouts) < _LAYOUTS:
            new = self._new_layout(raws[left[0]], kind, reader)
            if new is None:
                break
            self._layouts.append(new)
            left = self._take(new, raws, received, left, into)
        for k in left.tolist():
            into[:, k] = self._deserialized(raws[k], stamps[k], kind, reader)

    def _deserialized(self, raw: bytes, stamp: int, kind: str, reader: Any) -> list[float]:
        message = reader.deserialize(raw, kind)
        for name in _NAMES:
            self.names.update(getattr(message, name, ()))
        time, getters = _time(message, stamp), iter(self._getters)
        columns = [time if path == "t" else next(getters)(message) for path in self.fields.values()]
        return [time, *columns]

    def _new_layout(self, raw: bytes, kind: str, reader: Any) -> Layout | None:
        """The layout of a message, if it gives the numbers that deserializing gives."""
        layout = layout_of(raw, kind, reader.typestore.fielddefs, cdr=reader.is2)
        if layout is None:
            return None
        found = self._columns(layout, np.frombuffer(raw, np.uint8)[None], np.zeros(1, np.int64))
        expected = self._deserialized(raw, 0, kind, reader)
        same = np.array_equal([x[0] for x in found], expected, equal_nan=True)
        return layout if same else None

    def _take(
        self,
        layout: Layout,
        raws: Sequence[bytes],
        received: np.ndarray,
        left: np.ndarray,
        into: np.ndarray,
    ) -> np.ndarray:
        """Fill in the messages of a layout; returns the numbers of the others."""
        alike = [k for k in left if len(raws[k]) == layout.size]
        rows = np.frombuffer(b"".join(raws[k] for k in alike), np.uint8).reshape(-1, layout.size)
        same = (rows[:, layout.fixed] == layout.shared).all(axis=1)
        taken = np.array(alike, dtype=int)[same]
        for column, x in zip(into, self._columns(layout, rows[same], received[taken]), strict=True):
            column[taken] = x
        return np.setdiff1d(left, taken, assume_unique=True)

    def _columns(self, layout: Layout, rows: np.ndarray, received: np.ndarray) -> list[np.ndarray]:
        """The times and the columns of messages of a layout, given as bytes ``(n, size)``."""
        rows = np.ascontiguousarray(rows)

        def numbers(path: str) -> np.ndarray | None:
            if (place := layout.place(path)) is None:
                return None
            return np.ndarray(len(rows), place[1], rows, place[0], (layout.size,))

        seconds, rest = (numbers(path) for path in _STAMP)
        stamps = received
        if seconds is not None and rest is not None:
            own = 10**9 * seconds.astype(np.int64) + rest.astype(np.int64)
            stamps = np.where(own != 0, own, received)
        times = 1e-9 * stamps
        found = [times]
        for path in self.fields.values():
            column = times if path == "t" else numbers(path)
            found.append(np.full(len(rows), _NAN) if column is None else column.astype(float))
        return found


def _time(message: Any, stamp: int) -> float:
    header = getattr(message, "header", None)
    if header is not None and (header.stamp.sec or header.stamp.nanosec):
        stamp = 10**9 * header.stamp.sec + header.stamp.nanosec  # rounded once, as the other is
    return 1e-9 * stamp


def _getter(message: Any, field: str, place: str, arrays: dict[str, tuple[str, int]]) -> Get:
    """What takes the number at a path such as ``position/joint1`` out of a message, or NaN.

    It notes in ``arrays`` how long the arrays were.
    """
    *inner, last = field.split("/")
    names = next((name for name in _NAMES if hasattr(message, name)), None)
    at = message
    for step in inner:
        if step.isdigit():
            at = at[int(step)] if int(step) < len(at) else None
        else:
            at = getattr(at, step, None)
        if at is None:
            break
    if at is None or not (hasattr(at, "__len__") or hasattr(at, last)):
        raise LogError(
            f"{place}: its messages have no {field!r}: their fields are "
            f"{', '.join(_fields(message))}"
        )

    def missing(at: int, length: int) -> float:
        _, most = arrays.get(field, ("", 0))
        arrays[field] = "/".join(inner[:at]), max(most, length)
        return _NAN

    def get(one: Any) -> float:
        x = one
        for at, step in enumerate(inner):
            if step.isdigit():
                if int(step) >= len(x):
                    return missing(at, len(x))
                x = x[int(step)]
            else:
                x = getattr(x, step)
        if not hasattr(x, "__len__"):
            return _number(getattr(x, last), field, place)
        if last.isdigit():
            k = int(last)
        else:
            every = getattr(one, names) if names else ()
            k = every.index(last) if last in every else len(x)
        return _number(x[k], field, place) if k < len(x) else missing(len(inner), len(x))

    return get


def _number(x: Any, field: str, place: str) -> float:
    """A field as a number.

    Raises:
        LogError: on one that is none, as a stamp, a text or an array.
    """
    if isinstance(x, (int, float, np.number, np.bool_)):
        return float(x)
    if isinstance(x, str):
        what = "a text"
    elif hasattr(x, "__len__"):
        what = f"an array of {len(x)}"
        cure = f"name an entry of it, as {field + '/0'!r}, or by the name of a joint"
    else:
        what = str(getattr(x, "__msgtype__", type(x).__name__))
        cure = f"name one of its fields, {', '.join(_fields(x))}"
        if what.endswith("/Time"):
            cure = "the time of a message, in seconds, is the column '<topic>/t'"
    raise LogError(
        f"{place}: {field!r} is {what}, expected a number"
        + ("" if isinstance(x, str) else f": {cure}")
    )


def _fields(message: Any) -> list[str]:
    return [name for name in message.__dataclass_fields__ if not name.startswith("__")]
