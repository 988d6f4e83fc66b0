"""Log files that claim much, lead elsewhere or hold something else: refused in words."""

import gzip
import io
import os
import zipfile

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.data import log_formats as formats
from tests.data.logs_files import motion, source

TABLE = motion(6.0)
CSV = TABLE.to_csv(index=False)
SIZE = len(TABLE)
SIGNALS = {name: TABLE[[f"{name}1", f"{name}2"]].to_numpy() for name in "qvu"}


def refused(folder, message, **changes):
    with pytest.raises(ValueError, match=message) as caught:
        source(folder, **changes).load()
    assert len(str(caught.value)) < 900


def columns(prefix=""):
    units = {"q": "rad", "v": "rad/s", "u": "Nm"}
    return {
        name: dict(columns=[f"{prefix}{name}_1", f"{prefix}{name}_2"], unit=unit)
        for name, unit in units.items()
    }


def array(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def header(text):
    """An array file whose header says what it likes about what follows."""
    data = text.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(data).to_bytes(2, "little") + data


def shaped(shape):
    return header(f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}")


MEMBERS = {
    "8 TB of q": (dict(q=shaped("(1000000000000,)")), "variable 'q' .*larger than the memory"),
    "8 TB of time": (dict(t=shaped("(1000000000000,)")), "'t' .time.: claims to be larger"),
    "a negative size": (dict(q=shaped("(-1, 2)")), "variable 'q' .*is damaged"),
    "code for a header": (dict(q=header("__import__('os').mkdir('was_here')")), "is damaged"),
    "a deep header": (dict(q=header("(" * 5000)), "variable 'q' .*is damaged"),
    "no array": (dict(q=b"hello"), "variable 'q' .*is no array"),
    "one number for the time": (dict(t=array(np.array(3.0))), "'t' .time.: has 0 dimensions"),
    "no time": (dict(t=array(np.zeros(0))), "variable 'q' .*is 601 by 2, and the time has 0"),
    "texts": (dict(q=array(np.array(["a", "b"]))), "variable 'q' .*is a text"),
    "dates": (dict(t=array(np.zeros(SIZE, "M8[ns]"))), r"has the type datetime64\[ns\]"),
    "records": (dict(q=array(np.zeros(SIZE, [("a", "f8")]))), "variable 'q' .*has the type"),
    "a name twice": (dict(q_1=array(TABLE.q2.to_numpy())), "a variable of its own"),
}


def archive(path, members, compression=zipfile.ZIP_STORED):
    arrays = {"t": array(TABLE.t.to_numpy())} | {n: array(x) for n, x in SIGNALS.items()}
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, content in (arrays | members).items():
            file.writestr(f"{name}.npy", content)


@pytest.mark.parametrize(("members", "message"), MEMBERS.values(), ids=MEMBERS)
def test_an_npz_file_that_is_no_log(tmp_path, members, message):
    archive(tmp_path / "run.npz", members)
    refused(tmp_path, message, files="*.npz", **columns())


def test_an_npz_file_that_starts_as_an_array(tmp_path):
    archive(tmp_path / "run.npz", {})
    content = (tmp_path / "run.npz").read_bytes()
    (tmp_path / "run.npz").write_bytes(content[content.index(b"\x93NUMPY") :])
    refused(tmp_path, "run.npz: cannot be read as NPZ", files="*.npz", **columns())


def test_an_npz_file_that_unpacks_into_far_more(tmp_path):
    content = shaped("(30000000,)") + bytes(240_000_000)
    archive(tmp_path / "run.npz", {"q": content}, zipfile.ZIP_DEFLATED)
    refused(tmp_path, "variable 'q' .*bytes in .* compressed ones", files="*.npz", **columns())


def in_q(**settings):
    def change(file):
        del file["log/q"]
        file.create_dataset("log/q", **settings)

    return change


def deep(file):
    for _ in range(200):
        file = file.create_group("g")


OUTSIDE = [("/etc/passwd", 0, h5py.h5f.UNLIMITED)]
HDF5 = {
    "8 TB of q": (in_q(shape=(10**12, 2), dtype="f8"), "variable 'log/q' .*claims 16000000000000"),
    "another file": (in_q(shape=(SIZE, 2), dtype="f8", external=OUTSIDE), "lies in another file"),
    "complex": (in_q(data=np.ones((SIZE, 2)) * 1j), "variable 'log/q' .*has the type complex"),
    "ragged": (in_q(shape=(SIZE,), dtype=h5py.vlen_dtype("f8")), "'log/q' .*has the type object"),
    "nothing": (in_q(data=h5py.Empty("f8")), "variable 'log/q'"),
    "a name twice": (lambda f: f.create_dataset("log/q_1", data=TABLE.q2), "of its own"),
    "deep": (deep, "groups more than 30 levels deep"),
}
BESIDE = {
    "8 TB": lambda f: f.create_dataset("big", shape=(10**12,), dtype="f8"),
    "a type": lambda f: f.__setitem__("kind", np.dtype("f8")),
    "a way out": lambda f: f.__setitem__("out", h5py.ExternalLink("/etc/passwd", "/x")),
    "a circle": lambda f: f.__setitem__("log/again", f["log"]),
    "its own name": lambda f: f.__setitem__("loop", h5py.SoftLink("/loop")),
}


def hdf5(folder, change):
    """What describes a log in HDF5 that somebody has changed."""
    formats.write_hdf5(folder / "run.h5", TABLE)
    with h5py.File(folder / "run.h5", "a") as file:
        change(file)
    return {"files": "*.h5", "time": dict(columns="log/t", unit="s"), **columns("log/")}


@pytest.mark.parametrize(("change", "message"), HDF5.values(), ids=HDF5)
def test_an_hdf5_file_that_is_no_log(tmp_path, change, message):
    refused(tmp_path, message, **hdf5(tmp_path, change))


@pytest.mark.parametrize("change", BESIDE.values(), ids=BESIDE)
def test_what_nobody_asks_for_does_no_harm(tmp_path, change):
    assert source(tmp_path, **hdf5(tmp_path, change)).load().train


CELLS = {
    "structs": (pa.array([{"a": 1}] * SIZE), "column 'q1' .*expected a number"),
    "lists of lists": (pa.array([[[1.0]]] * SIZE), "variable 'q1' .*has entries of the type"),
    "nothing": (pa.array([None] * SIZE, pa.float64()), "is empty or NaN"),
    "bytes": (pa.array([b"\xff"] * SIZE), "column 'q1' .*expected a number"),
    "maps": (
        pa.array([[("a", 1.0)]] * SIZE, pa.map_(pa.string(), pa.float64())),
        "column 'q1' .*expected a number",
    ),
    "large numbers": (pa.array([2**63 - 1] * SIZE), "expected at most 1e"),
}


@pytest.mark.parametrize(("cells", "message"), CELLS.values(), ids=CELLS)
def test_a_parquet_column_that_holds_no_numbers(tmp_path, cells, message):
    table = pa.Table.from_pandas(TABLE)
    pq.write_table(table.set_column(1, "q1", cells), tmp_path / "run.parquet")
    refused(tmp_path, message, files="*.parquet")


INFOS = ["[]", '{"features": []}', '{"features": {"action": "x"}}', '{"features": null}']
INFOS += ["[" * 100_000, "{", '{"features": ' + "9" * 5000 + "}"]


@pytest.mark.parametrize("text", INFOS, ids=range(len(INFOS)))
def test_a_description_of_a_data_set_that_is_none(tmp_path, text):
    formats.write_lerobot(tmp_path, TABLE)
    (tmp_path / "meta" / "info.json").write_text(text)
    refused(
        tmp_path,
        "info.json: is no description of a LeRobot data set",
        files="data/*/*.parquet",
        time=dict(columns="timestamp", unit="s"),
        q=dict(columns=["observation.state/elbow"], unit="rad"),
        u=dict(columns=["action/elbow"], unit="Nm"),
        v=None,
    )


def test_a_compressed_file_that_unpacks_into_far_more(tmp_path):
    with gzip.open(tmp_path / "run.csv.gz", "wb", 1) as file:
        for _ in range(15):
            file.write(b"9" * 10**7)
    refused(tmp_path, "compressed bytes hold more than 100000000", files="*.gz")


WIDE = ",".join(f"c{k}" for k in range(20_000))
HEADERS = {
    "many names": (f"{WIDE}\n{WIDE}\n", "is the table transposed"),
    "a long name": ("t" * 10**6 + ",q1\n1,2\n", "is the table transposed"),
    "an open quote": (CSV.replace("q1", '"q1', 1), "cannot be read as CSV|no column"),
}


@pytest.mark.parametrize(("content", "message"), HEADERS.values(), ids=HEADERS)
def test_a_first_line_that_is_no_header(tmp_path, content, message):
    (tmp_path / "run.csv").write_text(content)
    refused(tmp_path, message)


def test_two_files_of_one_run(tmp_path):
    (tmp_path / "run.csv").write_text(CSV)
    with gzip.open(tmp_path / "run.csv.gz", "wt") as file:
        file.write(CSV)
    refused(tmp_path, "run.csv.gz are both the run 'run'", files=["*.csv", "*.gz"])


@pytest.mark.parametrize(("signal", "taken"), [("time", "t"), ("q", "q1"), ("v", "v1")])
def test_a_column_for_two_signals(tmp_path, signal, taken):
    with pytest.raises(ValueError, match=f"'{taken}' is given for {signal} and for u"):
        source(tmp_path, u=dict(columns=[taken, "u2"], unit="Nm"))


@pytest.mark.parametrize("given", [3, [3], [None], {"a": 1}, "x" * 5000, ["a", ""]])
def test_files_that_are_no_names(tmp_path, given):
    refused(tmp_path, "files", files=given)


@pytest.mark.parametrize(("key", "value"), [("scale", "two"), ("sign", None), ("offset", "x")])
def test_a_conversion_that_is_no_number(tmp_path, key, value):
    with pytest.raises(ValueError, match=rf"q: {key} is .*expected"):
        source(tmp_path, q=dict(columns=["q1", "q2"], unit="rad", **{key: value}))


def test_pipes_and_devices_are_no_logs(tmp_path):
    os.mkfifo(tmp_path / "a.csv")
    (tmp_path / "b.csv").symlink_to("/dev/zero")
    (tmp_path / "c.csv").symlink_to(tmp_path / "c.csv")
    refused(tmp_path, "nothing matches")
