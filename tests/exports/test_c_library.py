"""Functions compiled in C for this process, and the same functions without a compiler."""

import pytest

from pinn_dyn.exports import c_library
from pinn_dyn.exports.c_library import load_code


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path))


LIBRARY = "int number(void) { return 7; }\n"


@pytest.fixture
def library(tmp_path):
    """A library in the cache, which no process has loaded from there."""
    assert load_code(LIBRARY).number() == 7
    (path,) = tmp_path.glob("compiled/*")
    return path


def rebuilt(monkeypatch):
    """True if the next library is compiled instead of loaded from the cache."""
    compilations = []
    compile_c = c_library.compile_c
    monkeypatch.setattr(c_library, "compile_c", lambda *x: compilations.append(x) or compile_c(*x))
    assert load_code(LIBRARY).number() == 7
    return bool(compilations)


@pytest.mark.parametrize("content", [b"", None, b"\x7fELF of others"])
def test_a_damaged_library_is_built_again(library, monkeypatch, content):
    content = library.read_bytes()[:4096] if content is None else content
    library.unlink()  # this process has mapped the file
    library.write_bytes(content)
    assert rebuilt(monkeypatch)
    monkeypatch.undo()
    assert len(library.read_bytes()) > 4096


def test_a_library_serves_later_calls(library, monkeypatch):
    assert not rebuilt(monkeypatch)


@pytest.mark.parametrize("place", ["file", "folder", "owner"])
def test_files_that_others_own_or_may_write_are_not_loaded(library, monkeypatch, caplog, place):
    if place == "owner":
        monkeypatch.setattr("os.getuid", lambda: 12345)
    else:
        path = {"file": library, "folder": library.parent}[place]
        path.chmod(path.stat().st_mode | 0o020)
    assert rebuilt(monkeypatch)
    assert ("chmod -R go-w" in caplog.text) == (place != "file")
