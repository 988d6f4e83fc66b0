"""One log in every format that is read, to be damaged."""

import functools
import gzip
import tempfile
from pathlib import Path

from scipy.io import savemat

from tests.data import log_formats
from tests.data.logs_files import motion

MATRICES = {
    "q": dict(columns=["q_1", "q_2"], unit="rad"),
    "v": dict(columns=["v_1", "v_2"], unit="rad/s"),
    "u": dict(columns=["u_1", "u_2"], unit="Nm"),
}
IN_LOG = {
    name: {**part, "columns": [f"log/{x}" for x in part["columns"]]}
    for name, part in MATRICES.items()
} | {"time": dict(columns="log/t", unit="s")}


def write_mat(path, table, *, packed=False):
    arrays = {name: table[[f"{name}1", f"{name}2"]].to_numpy() for name in "qvu"}
    savemat(path, {"t": table[["t"]].to_numpy(), **arrays}, do_compression=packed)


def write_gzip(path, table):
    path.write_bytes(gzip.compress(table.to_csv(index=False).encode()))


def write_bag(path, table, *, mcap):
    """The file alone of a bag of ROS 2."""
    log_formats.write_bag(path.with_suffix(""), table, mcap=mcap)
    (file,) = path.with_suffix("").glob(f"*{path.suffix}")
    file.rename(path)


FORMATS = {
    "csv.gz": (write_gzip, {}),
    "npz": (log_formats.write_npz, MATRICES),
    "mat": (write_mat, MATRICES),
    "packed.mat": (functools.partial(write_mat, packed=True), MATRICES),
    "h5": (log_formats.write_hdf5, IN_LOG),
    "parquet": (lambda path, table: table.to_parquet(path), {}),
    "mcap": (functools.partial(write_bag, mcap=True), log_formats.BAG),
    "db3": (functools.partial(write_bag, mcap=False), log_formats.BAG),
    "bag": (functools.partial(log_formats.write_bag, version=1), log_formats.BAG),
}


@functools.cache
def formatted(name):
    """The bytes of the log in a format."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"run.{name}"
        FORMATS[name][0](path, motion(5.0))
        return path.read_bytes()
