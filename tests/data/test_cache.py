"""The disk cache: exact, atomic, made once by many processes, and remade if damaged or foreign."""

import io
import logging
import multiprocessing
import time
from pathlib import Path

import numpy as np
import pytest

from pinn_dyn.data.cache import cache_key, load_or_make

DESCRIPTION = {"mass": 0.3, "counts": [2, 3], "name": "arm"}


def small_arrays():
    return {"t": np.arange(5) * 0.1, "q": np.arange(6.0).reshape(2, 3) / 7}


class Maker:
    """Counts how often the arrays are made."""

    def __init__(self):
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return small_arrays()


@pytest.fixture
def make():
    return Maker()


def load(folder, make, description=DESCRIPTION):
    return load_or_make(folder, "arm", description, make)


def the_file(folder):
    (path,) = folder.glob("*.npz")
    return path


def assert_right(arrays):
    assert set(arrays) == {"t", "q"}
    for key, value in small_arrays().items():
        np.testing.assert_array_equal(arrays[key], value)


def test_a_second_load_reads_what_the_first_one_made(tmp_path, make):
    folder = tmp_path / "not" / "there" / "yet"
    assert_right(load(folder, make))
    assert_right(load(folder, make, dict(reversed(DESCRIPTION.items()))))
    assert make.calls == 1
    assert the_file(folder).name == f"arm-{cache_key(DESCRIPTION)}.npz"


@pytest.mark.parametrize("change", [{"mass": 0.3000001}, {"more": None}])
def test_another_description_is_made_beside_the_first(tmp_path, make, change):
    load(tmp_path, make)
    load(tmp_path, make, {**DESCRIPTION, **change})
    assert make.calls == 2
    assert len(list(tmp_path.glob("*.npz"))) == 2


# Damaged and foreign files.


def npz(**members):
    file = io.BytesIO()
    np.savez(file, **members)
    return file.getvalue()


CONTENTS = {
    "empty": b"",
    "text": b"hello",
    "a pickled array": npz(q=np.array([{}], dtype=object)),
}


@pytest.mark.parametrize("content", CONTENTS.values(), ids=CONTENTS)
def test_a_damaged_or_foreign_file_is_made_again(tmp_path, make, caplog, content):
    path = tmp_path / f"arm-{cache_key(DESCRIPTION)}.npz"
    path.write_bytes(content)
    assert_right(load(tmp_path, make))
    assert f"cache file {path} is damaged" in caplog.text
    assert_right(load(tmp_path, make))
    assert make.calls == 1


def test_no_flipped_byte_gives_wrong_arrays_or_stops_the_program(tmp_path, make):
    """Any byte of the file: it has no consequence, or the file is made again."""
    load(tmp_path, make)
    path = the_file(tmp_path)
    good = path.read_bytes()
    logging.disable(logging.WARNING)
    try:
        for position in range(0, len(good), 7):
            path.write_bytes(
                good[:position] + bytes([good[position] ^ 0xFF]) + good[position + 1 :]
            )
            assert_right(load(tmp_path, make))
    finally:
        logging.disable(logging.NOTSET)
    assert make.calls > len(good) // 7 // 3


# Writing.


def test_nothing_is_left_when_making_or_writing_fails(tmp_path, make, monkeypatch):
    def fail():
        raise RuntimeError("the solver gave up")

    with pytest.raises(RuntimeError, match="gave up"):
        load(tmp_path, fail)

    def half_written(file, **arrays):
        file.write(b"PK half of it")
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", half_written)
        with pytest.raises(OSError, match="no space left"):
            load(tmp_path, make)
    assert {path.suffix for path in tmp_path.iterdir()} <= {".lock"}
    assert_right(load(tmp_path, make))


def load_slowly(folder, barrier, results):
    """Load an entry whose making takes a while and leaves a line in a file."""

    def make():
        with (folder / "makes.txt").open("a") as file:
            file.write("made\n")
        time.sleep(0.5)
        return {"t": np.array([0.0, 0.5, 1.0])}

    barrier.wait(timeout=600)
    arrays = load_or_make(folder / "cache", "arm", DESCRIPTION, make)
    results.put({key: value.tolist() for key, value in arrays.items()})


def test_two_processes_at_once_make_the_file_once(tmp_path: Path):
    context = multiprocessing.get_context("fork")  # which has imported everything
    barrier, results = context.Barrier(2), context.Queue()
    workers = [
        context.Process(target=load_slowly, args=(tmp_path, barrier, results)) for _ in range(2)
    ]
    for worker in workers:
        worker.start()
    loaded = [results.get(timeout=600) for _ in workers]
    for worker in workers:
        worker.join(timeout=600)
    assert [worker.exitcode for worker in workers] == [0, 0]
    assert loaded == 2 * [{"t": [0.0, 0.5, 1.0]}]
    assert (tmp_path / "makes.txt").read_text().splitlines() == ["made"]
