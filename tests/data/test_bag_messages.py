"""Bags as robots record them: stamps, publishers, encodings, NaN, files without an end."""

import contextlib
import json
import sqlite3

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, message_factory
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from pinn_dyn.data.logs import LogError, Request
from pinn_dyn.data.logs.readers import find_files
from pinn_dyn.data.logs.readers.bags import read_bag
from tests.data.log_formats import STORE, STORE1
from tests.data.logs_files import motion

TABLE = motion(3.0)
T, Q, U = (np.ascontiguousarray(TABLE.filter(regex=f"^{name}")) for name in "tqu")
START = 1_700_000_000 * 10**9
STATES = "/joint_states"
JOINTS = ["j1", "j2"]
COLUMNS = [f"{STATES}/{x}/{joint}" for x in ("position", "effort") for joint in JOINTS]
NOTHING = np.array([])


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path / "cache"))


def read(path, columns=COLUMNS, topic=STATES):
    return read_bag(path, Request(f"{topic}/t", [f"{topic}/t", *columns]))


def joint_state(k, *, stamp=None, names=JOINTS, q=None, u=None):
    stamp = START + round(1e9 * T[k, 0]) if stamp is None else stamp
    time = STORE.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    header = STORE.types["std_msgs/msg/Header"](stamp=time, frame_id="")
    position, effort = Q[k] if q is None else q, U[k] if u is None else u
    return STORE.types["sensor_msgs/msg/JointState"](header, names, position, NOTHING, effort)


def write(path, items, kind="sensor_msgs/msg/JointState", topic=STATES, store=STORE, **options):
    """Write (receipt in s after the start, message) to a bag of ROS 2."""
    mode = options.pop("compression", None)
    options = {"version": 9, "storage_plugin": StoragePlugin.MCAP} | options
    writer = Writer(path, **options)
    if mode:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(topic, kind, typestore=store)
        for time, message in items:
            writer.write(connection, START + round(1e9 * time), store.serialize_cdr(message, kind))


def states(**changes):
    return [(t, joint_state(k, **changes)) for k, t in enumerate(T[:, 0])]


def assert_motion(table, rows=slice(None), shift=0.0):
    clock, *columns = table.frame.columns
    frame = table.frame.groupby(clock, as_index=False).first().dropna()
    np.testing.assert_allclose(frame[clock] - 1e-9 * START, T[rows, 0] + shift, atol=1e-6)
    np.testing.assert_allclose(frame[columns], np.hstack([Q, U])[rows])


def test_effort_that_is_nan_in_all_messages_is_named(tmp_path):
    write(tmp_path / "bag", states(u=np.array([np.nan, np.nan])))
    with pytest.raises(LogError, match=r"effort/j1' is NaN in all 301 messages.*/joint_states \("):
        read(tmp_path / "bag")


def test_messages_before_the_first_effort_have_empty_cells(tmp_path):
    first = [(t, joint_state(k, u=np.array([np.nan, 1.0]))) for k, t in enumerate(T[:50, 0])]
    write(tmp_path / "bag", first + states()[50:])
    table = read(tmp_path / "bag")
    assert_motion(table, slice(50, None))
    assert not table.notes


def test_messages_without_a_stamp_have_their_time_of_receipt(tmp_path):
    write(tmp_path / "zero", [(t + 0.25, m) for t, m in states(stamp=0)])
    table = read(tmp_path / "zero")
    assert_motion(table, shift=0.25)
    assert len(table.notes) == 1
    few = [(t, joint_state(k, stamp=0)) for k, t in enumerate(T[:3, 0])]  # before a clock starts
    write(tmp_path / "few", few + states()[3:])
    table = read(tmp_path / "few")
    assert_motion(table, slice(3, None))
    assert table.notes == ["3 of 301 messages of /joint_states with stamp 0 are dropped"]


@pytest.mark.parametrize(("first", "slower"), [(10**9, 2.0), (START + 5 * 10**9, 1.0)])
def test_commands_without_stamps_are_put_on_the_clock_of_the_states(tmp_path, first, slower):
    """Also beside a simulation that runs at half speed."""
    kind = "std_msgs/msg/Float64MultiArray"
    layout = STORE.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    with Writer(tmp_path / "bag", version=9) as writer:
        states, commands = (
            writer.add_connection(topic, x, typestore=STORE)
            for topic, x in ((STATES, "sensor_msgs/msg/JointState"), ("/commands", kind))
        )
        for k, t in enumerate(T[:, 0]):
            time = START + round(1e9 * slower * t)
            message = joint_state(k, stamp=round(1e9 * t) + first)
            writer.write(states, time, STORE.serialize_cdr(message, states.msgtype))
            message = STORE.types[kind](layout=layout, data=U[k])
            writer.write(commands, time, STORE.serialize_cdr(message, kind))
    table = read(tmp_path / "bag", [*COLUMNS[:2], "/commands/data/0", "/commands/data/1"])
    table.frame[f"{STATES}/t"] += 1e-9 * (START - first)
    assert_motion(table)
    assert table.notes == ["times of receipt put /commands on the clock of /joint_states"]


def test_a_gripper_on_the_topic_of_the_arm_is_named(tmp_path):
    one = np.array([0.1])
    grip = [(t + 0.002, joint_state(0, names=["finger"], q=one, u=one)) for t in T[::2, 0]]
    write(tmp_path / "bag", sorted(states() + grip, key=lambda x: x[0]))
    table = read(tmp_path / "bag")
    assert_motion(table)
    (note,) = table.notes
    assert "151 of 452" in note
    assert "finger" in note


def test_numbers_of_joints_that_change_their_order_are_refused(tmp_path):
    items = states()
    for k in range(0, len(T), 3):
        q = np.ascontiguousarray(Q[k, ::-1])
        items[k] = (T[k, 0], joint_state(k, names=JOINTS[::-1], q=q))
    write(tmp_path / "bag", items)
    with pytest.raises(
        LogError, match=r"belongs to j1, j2 by turns: write /joint_states/position/j1"
    ):
        read(tmp_path / "bag", [f"{STATES}/position/0"])
    table = read(tmp_path / "bag", COLUMNS[:2])
    np.testing.assert_allclose(table.frame[COLUMNS[:2]], Q)


def test_a_second_publisher_of_the_same_joints_is_left_out(tmp_path):
    kind = "sensor_msgs/msg/JointState"
    with Writer1(tmp_path / "run.bag") as writer:
        nodes = [
            writer.add_connection(STATES, kind, typestore=STORE1, callerid=name)
            for name in ("/robot", "/simulation")
        ]
        for k, t in enumerate(T[:, 0]):
            for node, delay in list(zip(nodes, (0, 3), strict=True))[: 1 + (k > 9)]:
                time = START + round(1e9 * t) + delay * 10**6
                stamp = STORE1.types["builtin_interfaces/msg/Time"](time // 10**9, time % 10**9)
                header = STORE1.types["std_msgs/msg/Header"](k, stamp, "")
                message = STORE1.types[kind](header, JOINTS, Q[k] + 0.1 * delay, NOTHING, U[k])
                writer.write(node, time, STORE1.serialize_ros1(message, kind))
    table = read(tmp_path / "run.bag")
    assert_motion(table)
    (note,) = table.notes
    assert note == "291 of 592 messages of /joint_states of another publisher are dropped"


def test_two_publishers_that_the_bag_does_not_tell_apart_are_named(tmp_path):
    """ROS 2: the second node sends other values 0.4 ms after the first."""
    items = []
    for k, (time, message) in enumerate(states()):
        stamp = START + round(1e9 * time) + 400_000
        items += [(time, message), (time + 4e-4, joint_state(k, stamp=stamp, q=Q[k] + 0.5))]
    write(tmp_path / "bag", items)
    with pytest.raises(LogError, match=r"two nodes publish /joint_states.*remap a node"):
        read(tmp_path / "bag")


@pytest.mark.parametrize(
    ("plugin", "mode"),
    [
        (StoragePlugin.MCAP, CompressionMode.FILE),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    ],
)
def test_compressed_bags(tmp_path, plugin, mode):
    version = 8 if plugin is StoragePlugin.SQLITE3 else 9
    write(tmp_path / "bag", states(), compression=mode, storage_plugin=plugin, version=version)
    assert_motion(read(tmp_path / "bag"))


def test_messages_without_definition_are_read_with_those_beside_the_bag(tmp_path):
    kind, text = "my_arm/msg/State", "float64[] q\nfloat64[] u\n"
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(text, kind))
    message = store.types[kind]
    items = [(t, message(Q[k], U[k])) for k, t in enumerate(T[:, 0])]
    options = dict(version=8, storage_plugin=StoragePlugin.SQLITE3)
    write(tmp_path / "bag", items, kind=kind, topic="/arm", store=store, **options)
    with contextlib.closing(sqlite3.connect(tmp_path / "bag" / "bag.db3")) as file, file:
        file.execute("DELETE FROM message_definitions")  # as before ROS 2 Iron
    columns = [f"/arm/{x}/{k}" for x in "qu" for k in (0, 1)]
    with pytest.raises(LogError, match=r"put it beside the bag as my_arm/msg/State\.msg"):
        read(tmp_path / "bag", columns, "/arm")
    (tmp_path / "bag" / "my_arm" / "msg").mkdir(parents=True)
    (tmp_path / "bag" / "my_arm" / "msg" / "State.msg").write_text(text)
    assert_motion(read(tmp_path / "bag", columns, "/arm"))


def test_joints_in_nested_lists_are_taken_by_name(tmp_path):
    text = """string[] joint_names
my_arm/Values[] interface_values
================================================================================
MSG: my_arm/Values
string[] interface_names
float64[] values
"""
    kind = "my_arm/msg/DynamicJointState"
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(text, kind))
    values = store.types["my_arm/msg/Values"]
    items = []
    for k, t in enumerate(T[:, 0]):
        entries = [values(["effort", "position"], np.array([U[k, j], Q[k, j]])) for j in (0, 1)]
        items.append((t, store.types[kind](JOINTS, entries)))
    write(tmp_path / "bag", items, kind=kind, topic="/arm", store=store)
    columns = [
        f"/arm/interface_values/{joint}/values/{x}"
        for x in ("position", "effort")
        for joint in JOINTS
    ]
    assert_motion(read(tmp_path / "bag", columns, "/arm"))
    with pytest.raises(LogError, match=r"which have interface_values/j1/values/effort, ") as error:
        read(tmp_path / "bag", ["/arm/position/j1"], "/arm")
    paths = str(error.value).partition("which have ")[2].split(", ")
    assert sorted(f"/arm/{path}" for path in paths) == sorted(columns)


def write_mcap(path, schema, encoding, messages):
    name, schema_encoding, data = schema
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=4000, compression=CompressionType.ZSTD)
        writer.start()
        number = writer.register_schema(name=name, encoding=schema_encoding, data=data)
        channel = writer.register_channel("/arm", encoding, number)
        for t, message in zip(T[:, 0], messages, strict=True):
            time = START + round(1e9 * t)
            writer.add_message(channel, log_time=time, publish_time=time, data=message)
        writer.finish()


def test_mcap_of_json(tmp_path):
    messages = [
        json.dumps(
            {
                "q": q.tolist(),
                "joints": [{"name": j, "u": x} for j, x in zip(JOINTS, u, strict=True)],
            }
        )
        for q, u in zip(Q, U, strict=True)
    ]
    schema = ("Arm", "jsonschema", b"{}")
    write_mcap(tmp_path / "run.mcap", schema, "json", [x.encode() for x in messages])
    columns = ["/arm/q/0", "/arm/q/1", "/arm/joints/j1/u", "/arm/joints/j2/u"]
    assert_motion(read(tmp_path / "run.mcap", columns, "/arm"))


def proto():
    """A message with a stamp of 0.5 s after its receipt, and two lists."""
    label, kinds = descriptor_pb2.FieldDescriptorProto, {"q": 1, "u": 1, "timestamp": 11}
    time = descriptor_pb2.FileDescriptorProto(name="time.proto", package="google.protobuf")
    stamp = time.message_type.add(name="Timestamp")
    stamp.field.add(name="seconds", number=1, type=3, label=label.LABEL_OPTIONAL)
    stamp.field.add(name="nanos", number=2, type=5, label=label.LABEL_OPTIONAL)
    arm = descriptor_pb2.FileDescriptorProto(name="arm.proto", dependency=["time.proto"])
    message = arm.message_type.add(name="Arm")
    for number, (name, kind) in enumerate(kinds.items(), start=1):
        repeat = label.LABEL_OPTIONAL if kind == 11 else label.LABEL_REPEATED
        field = message.field.add(name=name, number=number, type=kind, label=repeat)
        if kind == 11:
            field.type_name = ".google.protobuf.Timestamp"
    return descriptor_pb2.FileDescriptorSet(file=[arm, time])


def test_mcap_of_protobuf(tmp_path):
    files = proto()
    arm = message_factory.GetMessages(list(files.file))["Arm"]
    messages = []
    for k, t in enumerate(T[:, 0]):
        message = arm(q=Q[k], u=U[k])
        stamp = START + round(1e9 * t) + 500_000_000
        message.timestamp.seconds, message.timestamp.nanos = stamp // 10**9, stamp % 10**9
        messages.append(message.SerializeToString())
    schema = ("Arm", "protobuf", files.SerializeToString())
    write_mcap(tmp_path / "run.mcap", schema, "protobuf", messages)
    columns = [f"/arm/{x}/{k}" for x in "qu" for k in (0, 1)]
    assert_motion(read(tmp_path / "run.mcap", columns, "/arm"), shift=0.5)


def cut(data):
    """The file of a recorder that crashed."""
    return data[: len(data) // 2]


def flipped(data):
    """A file with a damaged chunk in its middle; chunks begin with the number of Zstandard."""
    first = data.index(b"\x28\xb5\x2f\xfd", len(data) // 2) + 20
    return data[:first] + bytes(x ^ 255 for x in data[first : first + 40]) + data[first + 40 :]


@pytest.mark.parametrize("damage", [cut, flipped])
def test_a_damaged_mcap_is_read_up_to_there_and_says_so(tmp_path, damage):
    messages = [json.dumps({"q": q.tolist(), "u": u.tolist()}) for q, u in zip(Q, U, strict=True)]
    path = tmp_path / "run.mcap"
    write_mcap(path, ("Arm", "jsonschema", b"{}"), "json", [x.encode() for x in messages])
    path.write_bytes(damage(path.read_bytes()))
    table = read(path, [f"/arm/{x}/{k}" for x in "qu" for k in (0, 1)], "/arm")
    assert 100 < len(table) < 200
    assert_motion(table, slice(len(table)))
    assert "damaged or has no end" in table.notes[0]


def test_the_files_of_a_bag_without_metadata_are_found(tmp_path):
    write(tmp_path / "run_1", states())
    write(tmp_path / "run_2", states())
    (tmp_path / "run_2" / "metadata.yaml").unlink()  # as after a crash
    whole, file = find_files(str(tmp_path), "run_*")
    assert (whole.name, file.name) == ("run_1", "run_2.mcap")
    assert_motion(read(file))


def test_a_missing_joint_is_answered_with_the_joints(tmp_path):
    write(tmp_path / "bag", states())
    with pytest.raises(LogError, match=r"position/elbow': the messages name j1, j2"):
        read(tmp_path / "bag", [f"{STATES}/position/elbow"])
    with pytest.raises(LogError, match=r"velocity/j1': its array is shorter"):
        read(tmp_path / "bag", [f"{STATES}/velocity/j1"])
