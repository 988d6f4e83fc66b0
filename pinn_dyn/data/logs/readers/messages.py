"""Decode the messages of bags: ROS 1 and ROS 2 by rosbags, MCAP files by mcap.

MCAP files may contain messages of ROS, JSON or protobuf. A file without an end, as after a crash of
the recorder, is read up to the damage.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar

from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.table import optional

_Item = TypeVar("_Item")
Message = tuple[str, int, int, Any]
"""Topic, number of the publisher, time of receipt in ns, and decoded message."""


class Bag(NamedTuple):
    """Types of messages by topic, iterator over messages, and notes.

    The notes are complete after the iteration.
    """

    topics: dict[str, str]
    messages: Callable[[Sequence[str]], Iterator[Message]]
    notes: list[str]


def open_bag(path: Path) -> AbstractContextManager[Bag]:
    """Open a bag of ROS, or an MCAP file."""
    return _mcap(path) if path.suffix == ".mcap" else _rosbag(path)


@contextmanager
def _rosbag(path: Path) -> Iterator[Bag]:
    common = _common_types(path)
    highlevel = optional("rosbags.highlevel", path)
    notes: list[str] = []
    with highlevel.AnyReader([path], default_typestore=common) as reader:
        _register(reader.typestore, common.fielddefs)

        def messages(topics: Sequence[str]) -> Iterator[Message]:
            connections = [item for item in reader.connections if item.topic in topics]
            for item in connections:
                _check_type(path, reader.typestore, item.msgtype)
            for item, received, raw in _up_to_damage(reader.messages(connections), notes):
                yield item.topic, item.id, received, reader.deserialize(raw, item.msgtype)

        yield Bag({item.topic: item.msgtype for item in reader.connections}, messages, notes)


def _up_to_damage(messages: Iterator[_Item], notes: list[str]) -> Iterator[_Item]:
    """Yield messages up to a damaged message and add a note. The first must be readable."""
    try:
        yield next(messages)
    except StopIteration:
        return
    try:
        yield from messages
    except Exception:
        notes[:] = ["the file is damaged or has no end, as after a crash: it is read up to there"]


@contextmanager
def _mcap(path: Path) -> Iterator[Bag]:
    library = optional("mcap.reader", path)
    notes: list[str] = []
    with path.open("rb") as file:

        def stream(topics: Sequence[str] | None) -> Iterator[tuple[Any, Any, Any]]:
            file.seek(0)
            reader = library.NonSeekingReader(file)
            messages = reader.iter_messages(topics, log_time_order=False)
            yield from _up_to_damage(messages, notes)

        schemas = {channel.topic: schema for schema, channel, _ in stream(None)}

        def messages(topics: Sequence[str]) -> Iterator[Message]:
            decoders: dict[int, Callable[[bytes], Any]] = {}
            for schema, channel, message in stream(topics):
                if channel.id not in decoders:
                    decoders[channel.id] = _decoder(path, schema, channel)
                decoded = decoders[channel.id](message.data)
                yield channel.topic, channel.id, message.log_time, decoded

        kinds = {topic: schema.name if schema else "json" for topic, schema in schemas.items()}
        yield Bag(kinds, messages, notes)


def _decoder(path: Path, schema: Any, channel: Any) -> Callable[[bytes], Any]:
    """Return the function that decodes the messages of a channel of an MCAP file."""
    encoding = channel.message_encoding
    if encoding == "json":
        return functools.partial(json.loads, object_hook=lambda x: SimpleNamespace(**x))
    if encoding == "protobuf":
        descriptors = optional("google.protobuf.descriptor_pb2", path)
        factory = optional("google.protobuf.message_factory", path)
        files = descriptors.FileDescriptorSet.FromString(schema.data).file
        return factory.GetMessages(list(files))[schema.name].FromString
    if encoding not in ("cdr", "ros1"):
        raise LogError(
            f"{path}, topic {channel.topic}: messages in {encoding!r} are not read, expected ROS "
            "(cdr, ros1), json or protobuf"
        )
    types = optional("rosbags.typesys", path)
    store = types.get_typestore(types.Stores.EMPTY)
    text = schema.data.decode()
    if schema.encoding.endswith("idl"):
        for part in re.split(r"=+\nIDL: .*\n", text):
            _register(store, types.get_types_from_idl(part))
    elif text:
        _register(store, types.get_types_from_msg(text, schema.name))
    if encoding == "cdr":
        _register(store, _common_types(path).fielddefs)
    _check_type(path, store, schema.name)
    deserialize = store.deserialize_cdr if encoding == "cdr" else store.deserialize_ros1
    return lambda data: deserialize(data, schema.name)


def _common_types(path: Path) -> Any:
    """Return the types of ROS 2, which old bags do not define, and those of ``*/msg/*.msg`` files.

    The files lie beside the bag.
    """
    types = optional("rosbags.typesys", path)
    store = types.get_typestore(types.Stores.ROS2_HUMBLE)
    for file in (path if path.is_dir() else path.parent).glob("*/msg/*.msg"):
        name = f"{file.parts[-3]}/msg/{file.stem}"
        _register(store, types.get_types_from_msg(file.read_text(), name))
    return store


def _register(store: Any, definitions: Mapping[str, Any]) -> None:
    """Add the types that a store does not have."""
    store.register({key: x for key, x in definitions.items() if key not in store.fielddefs})


def _check_type(path: Path, store: Any, kind: str) -> None:
    if kind not in store.fielddefs:
        package, *_, name = kind.split("/")
        raise LogError(
            f"{path}: no definition of the messages {kind}: put it beside the bag as "
            f"{package}/msg/{name}.msg, with the definitions that it uses"
        )
