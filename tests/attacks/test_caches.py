"""Cache files of others: none is believed, or unpickled; the data are made again."""

import io
import json
import os
import pickle
import zipfile

import numpy as np
import pytest

from pinn_dyn.data.cache import cache_key, load_or_make

WANTED = {"mass": 0.3, "name": "arm"}
RIGHT = {"q": np.arange(6.0).reshape(2, 3), "t": np.arange(3.0)}


class Marker:
    """A pickle that makes a folder when it is read as code."""

    def __reduce__(self):
        return os.mkdir, ("was_here",)


def npz(**members):
    file = io.BytesIO()
    np.savez(file, **members)
    return file.getvalue()


def named(description=WANTED, **arrays):
    arrays = arrays or RIGHT
    return npz(description=np.array(json.dumps(description)), names=np.array([*arrays]), **arrays)


def archive(**entries):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as into:
        for name, content in entries.items():
            into.writestr(name, content)
    return file.getvalue()


def header(text):
    """An array file whose header says what it likes about what follows."""
    data = text.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + len(data).to_bytes(2, "little") + data


HUGE = header("{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000,), }")
CODE = header("__import__('os').mkdir('was_here')")
MARKED = np.array([Marker()], dtype=object)

CONTENTS = {
    "empty": b"",
    "text": b"hello",
    "a pickle": pickle.dumps(Marker()),
    "an array alone": header("{'descr': '<f8', 'fortran_order': False, 'shape': (), }") + bytes(8),
    "an empty archive": archive(),
    "no description": npz(**RIGHT),
    "a pickled description": npz(description=MARKED, names=np.array(["q"]), q=np.ones(1)),
    "pickled names": npz(description=np.array(json.dumps(WANTED)), names=MARKED),
    "a pickled array": named(q=MARKED, t=np.ones(1)),
    "of another arm": named({**WANTED, "mass": 0.4}),
    "a list for a description": named([1, 2]),
    "no JSON": npz(description=np.array("{"), names=np.array(["q"]), q=np.ones(1)),
    "deep JSON": npz(description=np.array("[" * 100_000), names=np.array(["q"]), q=np.ones(1)),
    "NaN": npz(description=np.array('{"mass": NaN}'), names=np.array(["q"]), q=np.ones(1)),
    "a name too many": npz(
        description=np.array(json.dumps(WANTED)), names=np.array(["q", "t", "x"]), **RIGHT
    ),
    "code for a header": archive(**{"description.npy": CODE, "names.npy": CODE}),
    "8 TB": archive(**{"description.npy": HUGE, "names.npy": HUGE}),
    "no arrays": archive(**{"description.npy": b"hello", "names.npy": b"hello"}),
    "a way out": archive(**{"../../was_here.npy": b"x"}),
}  # fmt: skip


@pytest.mark.parametrize("content", CONTENTS.values(), ids=CONTENTS)
def test_a_cache_file_of_others_is_made_again(tmp_path, caplog, content):
    path = tmp_path / f"arm-{cache_key(WANTED)}.npz"
    path.write_bytes(content)
    found = load_or_make(tmp_path, "arm", WANTED, lambda: RIGHT)
    assert found.keys() == RIGHT.keys()
    for name, value in RIGHT.items():
        np.testing.assert_array_equal(found[name], value)
    assert f"cache file {path} is damaged" in caplog.text
    assert path.with_suffix(".damaged").read_bytes() == content
    again = load_or_make(tmp_path, "arm", WANTED, lambda: pytest.fail("it was not kept"))
    assert again.keys() == RIGHT.keys()


def test_a_folder_in_the_place_of_the_file(tmp_path, caplog):
    path = tmp_path / f"arm-{cache_key(WANTED)}.npz"
    path.mkdir()
    assert load_or_make(tmp_path, "arm", WANTED, lambda: RIGHT).keys() == RIGHT.keys()
    assert f"cache file {path} is damaged" in caplog.text
