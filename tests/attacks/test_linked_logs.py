"""HDF5 files that point to other files: nothing of them is read."""

import h5py
import numpy as np
import pytest

from pinn_dyn.data.logs import LogError
from tests.data import log_formats
from tests.data.logs_files import motion, named, source

SECRET = np.linspace(0.0, 1.0, 501)


def external_link(group, path):
    group["far"] = h5py.ExternalLink(str(path), "/secret")


def external_storage(group, path):
    group.create_dataset("far", SECRET.shape, "f8", external=[(str(path), 0, h5py.h5f.UNLIMITED)])


def virtual(group, path):
    layout = h5py.VirtualLayout(SECRET.shape, "f8")
    layout[:] = h5py.VirtualSource(str(path), "secret", SECRET.shape)
    group.create_virtual_dataset("far", layout)


@pytest.fixture(params=[external_link, external_storage, virtual])
def linked(tmp_path, request):
    """Return a function that adds ``log/far``, which another file holds, to a file."""
    (tmp_path / "secret").mkdir()
    secret = tmp_path / "secret" / "file.h5"
    with h5py.File(secret, "w") as file:
        file["secret"] = SECRET

    def add(path):
        with h5py.File(path, "a") as file:
            request.param(file["log"], secret)

    return add


@pytest.mark.parametrize("suffix", ["h5", "mat"])
def test_values_of_other_files_are_refused(tmp_path, linked, suffix):
    path = tmp_path / f"run.{suffix}"
    dot = "/" if suffix == "h5" else "."
    columns = named(f"log{dot}{{}}_{{}}", f"log{dot}t")
    (log_formats.write_hdf5 if suffix == "h5" else log_formats.write_mat73)(path, motion(5.0))
    linked(path)
    columns["u"] = dict(columns=[f"log{dot}far"], unit="Nm")
    with pytest.raises(LogError, match="log/far: values of other files"):
        source(tmp_path, files=path.name, **columns).load()
