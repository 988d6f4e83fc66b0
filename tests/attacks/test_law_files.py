"""Law files, which are machine code: what can be refused is, before any of it is loaded."""

import hashlib
import json
import zipfile

import pytest
import torch

from pinn_dyn.control import load_law

INFO = {
    "law": "Tracking",
    "num_coordinates": 2,
    "num_inputs": 2,
    "torch": "0.0.1",
    "check": {"states": [], "u": []},
}
METADATA = "law/data/aotinductor/model/x.wrapper_metadata.json"


def describing(info):
    return {
        METADATA: json.dumps({"pinn_dyn_law": info if isinstance(info, str) else json.dumps(info)})
    }


def write(path, entries):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return path


@pytest.fixture(autouse=True)
def nothing_is_loaded(monkeypatch):
    def load(*_, **__):
        pytest.fail("it was loaded")

    monkeypatch.setattr(torch._inductor, "aoti_load_package", load)


NAMES = [
    *("../was_here", "a/../../was_here", "a/..", "..", "/was_here", "//host/was_here", "/"),
    *("\\was_here", "..\\was_here", "a\\..\\..\\was_here", "C:\\was_here", "c:was_here"),
]


@pytest.mark.parametrize("name", NAMES)
def test_an_entry_that_leads_out_is_refused(tmp_path, name):
    path = write(tmp_path / "law.pt2", {**describing(INFO), name: "x"})
    with pytest.raises(ValueError, match="expected names inside the archive") as caught:
        load_law(path)
    assert f"{path} holds the entry {name!r}" in str(caught.value)


def test_a_name_that_ends_early_for_c_is_refused(tmp_path):
    path = write(tmp_path / "law.pt2", {**describing(INFO), "law/xyz.so": "x"})
    path.write_bytes(path.read_bytes().replace(b"law/xyz.so", b"law/x\0/../"))
    with pytest.raises(ValueError, match="expected names inside the archive"):
        load_law(path)


NO_LAW = {
    "nothing": {},
    "other metadata": {METADATA: "{}"},
    "no JSON": {METADATA: "{"},
    "a list": {METADATA: "[1]"},
    "a number": {METADATA: "7"},
    "no JSON for a law": describing("{"),
    "an object for a law": {METADATA: json.dumps({"pinn_dyn_law": {"law": 1}})},
}


@pytest.mark.parametrize("entries", NO_LAW.values(), ids=NO_LAW)
def test_a_package_that_is_no_law_is_refused(tmp_path, entries):
    path = write(tmp_path / "law.pt2", entries)
    with pytest.raises(ValueError, match=r"law.pt2 is a package, but no law that export_law wrote"):
        load_law(path)


def flip(data):
    where = data.index(b"Tracking")
    return data[:where] + b"Trackinh" + data[where + 8 :]


@pytest.mark.parametrize(
    "damage",
    [lambda _: b"", lambda _: b"hello", lambda x: x[:-30], lambda x: x[: len(x) // 2], flip],
    ids=["empty", "text", "cut", "half", "a flipped bit"],
)
def test_a_damaged_file_is_refused(tmp_path, damage):
    path = write(tmp_path / "law.pt2", describing(INFO))
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=r"law.pt2 is no exported law, or it is cut short"):
        load_law(path)


def test_another_checksum_is_refused_before_the_file_is_looked_at(tmp_path):
    path = write(tmp_path / "law.pt2", {"../was_here": "x"})
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    other = "0" * 64
    with pytest.raises(ValueError, match=rf"law.pt2 has the SHA-256 {found}, expected {other}"):
        load_law(path, sha256=other)
    for text in (found, found.upper(), f" {found}\n"):
        with pytest.raises(ValueError, match="holds the entry"):
            load_law(path, sha256=text)


def test_another_version_of_pytorch_is_refused(tmp_path):
    path = write(tmp_path / "law.pt2", describing(INFO))
    with pytest.raises(RuntimeError, match=r"exported with torch 0\.0\.1"):
        load_law(path)
