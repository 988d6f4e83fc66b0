"""One log in every format that is read, to be damaged."""

import functools
import tempfile
from pathlib import Path

from tests.data.log_formats import FORMATS
from tests.data.logs_files import motion

DAMAGED = ["csv.gz", "npz", "mat", "packed.mat", "h5", "parquet", "mcap", "db3", "bag"]


@functools.cache
def formatted(name):
    """The bytes of the log in a format."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"run.{name}"
        FORMATS[name][0](path, motion(5.0))
        return path.read_bytes()
