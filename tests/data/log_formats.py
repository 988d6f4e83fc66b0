"""The motion of the oscillator in every format, written without a robot's software."""

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE1 = get_typestore(Stores.ROS1_NOETIC)
JOINTS = ["elbow", "shoulder"]  # not in the order in which they are asked for
BAG = dict(
    time=dict(columns="/joint_states/t", unit="s"),
    q=dict(columns=[f"/joint_states/position/{j}" for j in reversed(JOINTS)], unit="rad"),
    v=dict(columns=[f"/joint_states/velocity/{j}" for j in reversed(JOINTS)], unit="rad/s"),
    u=dict(columns=["/commands/data/0", "/commands/data/1"], unit="Nm"),
)
LEROBOT = dict(
    files="data/*/*.parquet",
    trajectory="episode_index",
    time=dict(columns="timestamp", unit="s"),
    q=dict(columns=["observation.state_1", "observation.state_2"], unit="rad"),
    v=None,
    u=dict(columns=["action_1", "action_2"], unit="Nm"),
)


def time_of(t, store):
    t = round(t * 1e9)
    return store.types["builtin_interfaces/msg/Time"](sec=t // 10**9, nanosec=t % 10**9)


def joint_state(row, k, store, *, empty=False):
    """The message of one row; every second one has its joints in the other order."""
    order = [1, 0] if k % 2 else [0, 1]
    names = [JOINTS[i] for i in order]
    q, v = ([float(row[f"{x}{2 - i}"]) for i in order] for x in "qv")
    header = {"stamp": time_of(row["t"], store), "frame_id": ""}
    if store is STORE1:
        header["seq"] = k
    return store.types["sensor_msgs/msg/JointState"](
        header=store.types["std_msgs/msg/Header"](**header),
        name=["gripper"] if empty else names,
        position=np.array([0.5] if empty else q),
        velocity=np.array([] if empty else v),
        effort=np.array([]),
    )


def commands(row, store):
    layout = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    data = np.array([row["u1"], row["u2"]])
    return store.types["std_msgs/msg/Float64MultiArray"](layout=layout, data=data)


def write_bag(path, table, *, version=2, mcap=True, late=0.0, empty_every=None, twice=False):
    """Joint states, and commands ``late`` s after each of them as received."""
    store = STORE if version == 2 else STORE1
    if version == 2:
        plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
        writer = Writer(path, version=9, storage_plugin=plugin)
    else:
        writer = Writer1(path)
    serialize = store.serialize_cdr if version == 2 else store.serialize_ros1
    with writer:
        topics = (
            ("/joint_states", "sensor_msgs/msg/JointState"),
            ("/commands", "std_msgs/msg/Float64MultiArray"),
        )
        states, inputs = (
            writer.add_connection(topic, kind, typestore=store) for topic, kind in topics
        )
        messages = []
        for k, row in enumerate(table.to_dict("records")):
            stamp = round(1e9 * row["t"])
            message = joint_state(row, k, store)
            messages.append((stamp, states, message))
            if empty_every and k % empty_every == 0:
                messages.append((stamp, states, joint_state(row, k, store, empty=True)))
            if twice:
                messages.append((stamp, inputs, commands({**row, "u1": 99.0}, store)))
            messages.append((stamp + round(1e9 * late), inputs, commands(row, store)))
        for stamp, connection, message in sorted(messages, key=lambda m: m[0]):
            writer.write(connection, stamp, serialize(message, connection.msgtype))


def write_hdf5(path, table):
    with h5py.File(path, "w") as file:
        file["log/t"] = table["t"].to_numpy()
        for name in "qvu":
            file[f"log/{name}"] = table[[f"{name}1", f"{name}2"]].to_numpy()
        file["log/gains"] = np.eye(3)


def write_npz(path, table, **more):
    signals = {name: table[[f"{name}1", f"{name}2"]].to_numpy() for name in "qvu"}
    np.savez(path, t=table["t"].to_numpy(), **{**signals, **more})


def write_lerobot(folder, table, episodes=3):
    """A LeRobot folder of episodes in one Parquet file."""
    rows = [table.assign(q1=table["q1"] + 0.01 * k) for k in range(episodes)]
    data = {
        "timestamp": np.concatenate([x["t"] for x in rows]),
        "episode_index": np.repeat(np.arange(episodes), len(table)),
        "observation.state": [[r.q1, r.q2] for x in rows for r in x.itertuples()],
        "action": [[r.u1, r.u2] for x in rows for r in x.itertuples()],
    }
    place = folder / "data" / "chunk-000"
    place.mkdir(parents=True)
    pq.write_table(pa.table(data), place / "file-000.parquet")
