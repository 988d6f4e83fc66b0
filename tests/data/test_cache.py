"""The disk cache: exact, atomic, self-healing, and made once however many ask."""

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
    assert_right(load(folder, make))
    assert make.calls == 1
    assert the_file(folder).name == f"arm-{cache_key(DESCRIPTION)}.npz"


@pytest.mark.parametrize(
    "change", [{"mass": 0.3000001}, {"counts": [3, 2]}, {"name": "leg"}, {"more": None}]
)
def test_any_change_of_the_description_changes_the_key(change):
    assert cache_key({**DESCRIPTION, **change}) != cache_key(DESCRIPTION)


def test_the_key_does_not_depend_on_the_order_of_names():
    assert cache_key(dict(reversed(DESCRIPTION.items()))) == cache_key(DESCRIPTION)


def test_another_description_is_made_beside_the_first(tmp_path, make):
    load(tmp_path, make)
    load(tmp_path, make, {**DESCRIPTION, "mass": 0.4})
    assert make.calls == 2
    assert len(list(tmp_path.glob("*.npz"))) == 2


def test_the_file_holds_no_pickle_and_its_description(tmp_path, make):
    load(tmp_path, make)
    with np.load(the_file(tmp_path), allow_pickle=False) as archive:
        members = {key: archive[key] for key in archive.files}
    assert set(members) >= {"t", "q", "description"}
    assert '"mass": 0.3' in str(members["description"])


def truncate(data):
    return data[: len(data) // 2]


def empty(data):
    return b""


def flip_in_the_middle(data):
    """A byte of an array: the archive still opens."""
    where = data.index(np.float64(0.4).tobytes())
    return data[:where] + bytes([data[where] ^ 1]) + data[where + 1 :]


def not_an_archive(data):
    return b"something else altogether"


@pytest.mark.parametrize("damage", [truncate, empty, flip_in_the_middle, not_an_archive])
def test_a_damaged_file_is_reported_kept_aside_and_made_again(tmp_path, make, damage, caplog):
    load(tmp_path, make)
    path = the_file(tmp_path)
    damaged = damage(path.read_bytes())
    path.write_bytes(damaged)
    with caplog.at_level(logging.WARNING, logger="pinn_dyn"):
        assert_right(load(tmp_path, make))
    assert make.calls == 2
    assert str(path) in caplog.text
    aside = path.with_suffix(".damaged")
    assert aside.name in caplog.text
    assert aside.read_bytes() == damaged
    assert_right(load(tmp_path, make))
    assert make.calls == 2


def test_no_flipped_byte_gives_wrong_arrays_or_stops_the_program(tmp_path, make):
    """Every byte of the file in turn: it is either without consequence or the file is remade."""
    load(tmp_path, make)
    path = the_file(tmp_path)
    good = path.read_bytes()
    failures = {}
    logging.disable(logging.WARNING)
    try:
        for where in range(len(good)):
            path.write_bytes(good[:where] + bytes([good[where] ^ 0xFF]) + good[where + 1 :])
            try:
                assert_right(load(tmp_path, make))
            except Exception as error:
                failures[where] = repr(error)
    finally:
        logging.disable(logging.NOTSET)
    assert make.calls > len(good) // 3
    assert not failures


def test_nothing_is_left_when_making_fails(tmp_path):
    def fail():
        raise RuntimeError("the solver gave up")

    with pytest.raises(RuntimeError, match="gave up"):
        load(tmp_path, fail)
    assert {path.suffix for path in tmp_path.iterdir()} <= {".lock"}


def test_nothing_is_left_when_writing_fails(tmp_path, make, monkeypatch):
    def half_written(file, **arrays):
        file.write(b"PK half of it")
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", half_written)
        with pytest.raises(OSError, match="no space left"):
            load(tmp_path, make)
    assert {path.suffix for path in tmp_path.iterdir()} <= {".lock"}
    assert_right(load(tmp_path, make))


def test_the_final_name_appears_only_with_the_whole_file(tmp_path, make, monkeypatch):
    seen = []
    savez = np.savez

    def watched(file, **arrays):
        savez(file, **arrays)
        seen.append(sorted(path.suffix for path in tmp_path.iterdir()))

    monkeypatch.setattr(np, "savez", watched)
    load(tmp_path, make)
    assert seen == [[".lock", ".partial"]]


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
    found = [results.get(timeout=600) for _ in workers]
    for worker in workers:
        worker.join(timeout=600)
    assert [worker.exitcode for worker in workers] == [0, 0]
    expected = {"t": [0.0, 0.5, 1.0]}
    assert found == [expected, expected]
    assert (tmp_path / "makes.txt").read_text().splitlines() == ["made"]
