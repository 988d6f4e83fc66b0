"""Functions compiled in C for this process, and the same functions without a compiler."""

import pytest
import torch

from pinn_dyn.exports import c_library
from pinn_dyn.exports.c_library import compiled_rows, load_code


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path))


def test_rows_are_those_of_the_function_also_where_they_are_not_finite():
    weights = torch.rand(30, 3, dtype=torch.float64)
    x = 20 * torch.randn(5, 4, 3, dtype=torch.float64)
    x[1, 2, 0], x[3, 0, 2] = torch.nan, torch.inf
    for scale in (1.0, 0.5):  # other numbers are another library

        def function(x, scale=scale):
            y = torch.nn.functional.softplus(scale * x @ weights.T)
            return torch.tanh(y / 50) * torch.exp(-y) + torch.relu(y - 3)

        rows = compiled_rows(function, x[0, 0])
        assert rows is not function
        torch.testing.assert_close(rows(x), function(x), rtol=1e-12, atol=0, equal_nan=True)
        columns = x.mT.contiguous().mT
        torch.testing.assert_close(rows(columns), rows(x), rtol=0, atol=0, equal_nan=True)


def test_a_cache_folder_that_cannot_be_made_does_not_prevent_compiling(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path / "file"))
    x = torch.rand(3, dtype=torch.float64)
    rows = compiled_rows(torch.sin, x)
    assert rows is not torch.sin
    torch.testing.assert_close(rows(x), x.sin(), rtol=1e-12, atol=0)


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


def test_without_a_compiler_or_c_code_the_function_remains(monkeypatch):
    x = torch.rand(3, dtype=torch.float64)
    sorted_rows = lambda x: x.sort(-1).values  # noqa: E731
    assert compiled_rows(sorted_rows, x) is sorted_rows
    monkeypatch.setenv("CC", "no-such-compiler")
    assert compiled_rows(torch.sin, x) is torch.sin
