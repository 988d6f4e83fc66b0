"""The motion of the oscillator in every format, written without a robot's software."""

import functools
import gzip
import json

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.io import savemat

from tests.data.logs_files import arrays_of, named

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


def write_bag_file(path, table, **options):
    """The file alone of a bag of ROS 2."""
    folder = path.with_name("bag")
    write_bag(folder, table, **options)
    (file,) = folder.glob(f"*{path.suffix}")
    file.rename(path)


def write_hdf5(path, table):
    with h5py.File(path, "w") as file:
        for name, values in arrays_of(table).items():
            file[f"log/{name}"] = values
        file["log/gains"] = np.eye(3)


def write_compound(path, table):
    """A data set of structures beside images of 180 GB, which are not loaded."""
    rows = np.zeros(len(table), [("t", "f8"), *((name, "f8", 2) for name in "qvu"), ("mode", "S4")])
    for name, values in arrays_of(table).items():
        rows[name] = values
    with h5py.File(path, "w") as file:
        file["log"] = rows
        file.create_dataset("images", (len(table), 9999, 9999, 3), "u1")


def write_mat73(path, table):
    """Write a MAT file of version 7.3: HDF5 after a header, with transposed matrices."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in arrays_of(table).items():
            data = file.create_dataset(f"log/{name}", data=np.atleast_2d(values.T))
            data.attrs["MATLAB_class"] = np.bytes_("double")
        file["log"].attrs["MATLAB_class"] = np.bytes_("struct")
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    content = path.read_bytes()
    path.write_bytes(head + content[len(head) :])


def write_mat(path, table, *, packed=False):
    arrays = arrays_of(table)
    savemat(path, arrays | {"t": arrays["t"][:, None]}, do_compression=packed)


def write_npz(path, table, **more):
    np.savez(path, **arrays_of(table) | more)


def write_nested_parquet(path, table):
    """Structures, nested lists and an index."""
    arrays = arrays_of(table)
    frame = pd.DataFrame({"state": [{"q": {"a": x, "b": y}} for x, y in arrays["q"]]})
    frame["u"] = [[[x], [y]] for x, y in arrays["u"]]
    frame.set_axis(pd.Index(table["t"], name="t")).to_parquet(path)


def tensors(table):
    return {name: torch.tensor(x, requires_grad=True) for name, x in arrays_of(table).items()}


def records(table):
    """The rows as nested vectors."""
    arrays = {name: x.tolist() for name, x in arrays_of(table).items()}
    rows = zip(*(arrays[name] for name in "tqvu"), strict=True)
    return [{"t": t, "state": {"q": q}, "v": v, "u": u} for t, q, v, u in rows]


def json_arrays(table):
    arrays = {name: x.tolist() for name, x in arrays_of(table).items()}
    return {**arrays, "state": {"q": arrays.pop("q")}}


def write_json(path, table, *, form):
    content = form(table)
    lines = map(json.dumps, content) if path.suffix == ".jsonl" else [json.dumps(content)]
    path.write_text("\n".join(lines))


VECTORS = named("{}_{}")
NUMBERS = {
    name: dict(columns=[str(k) for k in places], unit=unit)
    for name, places, unit in (("q", (1, 4), "rad"), ("v", (2, 5), "rad/s"), ("u", (3, 6), "Nm"))
} | {"time": dict(columns="0", unit="s")}
NESTED = VECTORS | {"q": dict(columns=["state.q_1", "state.q_2"], unit="rad")}
STRUCTS = {"q": dict(columns=["state.q.a", "state.q.b"], unit="rad"), "v": None}
FORMATS = {
    # Ending: function that writes a table to a path, and the columns of the source.
    "csv.gz": (lambda path, table: path.write_bytes(gzip.compress(table.to_csv().encode())), {}),
    "npz": (write_npz, VECTORS),
    "npy": (lambda path, table: np.save(path, table.to_numpy()), NUMBERS),
    "structured.npy": (lambda path, table: np.save(path, table.to_records(index=False)), {}),
    "pt": (lambda path, table: torch.save(tensors(table), path), VECTORS),
    "nested.pt": (
        lambda path, table: torch.save({"log": tensors(table)}, path),
        named("log.{}_{}", "log.t"),
    ),
    "matrix.pt": (lambda path, table: torch.save(torch.tensor(table.to_numpy()), path), NUMBERS),
    "mat": (write_mat, VECTORS),
    "packed.mat": (functools.partial(write_mat, packed=True), VECTORS),
    "73.mat": (write_mat73, named("log.{}_{}", "log.t")),
    "hdf.mat": (write_hdf5, named("log/{}_{}", "log/t")),
    "h5": (write_hdf5, named("log/{}_{}", "log/t")),
    "compound.h5": (write_compound, named("log/{}_{}", "log/t")),
    "parquet": (lambda path, table: table.to_parquet(path), {}),
    "nested.parquet": (write_nested_parquet, VECTORS | STRUCTS),
    "json": (functools.partial(write_json, form=json_arrays), NESTED),
    "records.json": (
        lambda path, table: table.to_json(path, orient="records", double_precision=15),
        {},
    ),
    "marked.json": (
        lambda path, table: path.write_text("\ufeff" + table.to_json(orient="records"), "utf-8"),
        {},
    ),
    "vectors.json": (functools.partial(write_json, form=records), NESTED),
    "jsonl": (functools.partial(write_json, form=records), NESTED),
    "mcap": (write_bag_file, BAG),
    "gripper.mcap": (functools.partial(write_bag_file, empty_every=7), BAG),
    "db3": (functools.partial(write_bag_file, mcap=False), BAG),
    "bag": (functools.partial(write_bag, version=1), BAG),
}
"""Formats of one table. In gripper.mcap, a second node publishes positions on the same topic."""


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
