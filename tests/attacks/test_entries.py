"""reproduce.py on words and lists of entries that cannot be: a sentence before anything is run."""

from pathlib import Path

import pytest
import yaml

import reproduce
from pinn_dyn.app.config import ConfigError
from pinn_dyn.app.words import parsed

TRAINS = {"train": ["seed=0"], "evaluate": [], "minutes": 1}
GOOD = {"a/lnn": TRAINS, "control/a": {"control": [], "runs": ["a/lnn"], "minutes": 1}}


def with_key(key, value, name="a/lnn"):
    """The good entries, with one key of one of them exchanged."""
    return {**GOOD, name: {**GOOD[name], key: value}}


BROKEN = {
    "nothing": (b"", "holds no configuration"),
    "a list": (b"[1]", "holds no configuration"),
    "no YAML": (b"entries: {", "cannot be read, it may be damaged"),
    "no text": (b"\xff\xfe\0", "cannot be read"),
    "a tag": (b"!!python/object/apply:os.system [touch was_here]", "cannot be read"),
    "no entries": ({}, "entries is None, expected a mapping"),
    "a number": ({"a": 3}, "entries.a is 3, expected a mapping with train, evaluate"),
    "an empty entry": (
        {"a": {}},
        "entries.a has nothing, expected train and evaluate, or evaluate",
    ),
    "half an entry": ({"a": {"train": []}}, "entries.a has train, expected train and evaluate"),
    "its own run": (
        with_key("runs", ["a/lnn"]),
        r"lnn.runs has 'a/lnn', expected entries above it",
    ),
    "a way out": ({"../x": TRAINS}, "entries has '../x', expected the name of a folder"),
    "another place": ({"/tmp/x": TRAINS}, "entries has '/tmp/x', expected the name of a folder"),
    "a number for a name": ({3: TRAINS}, "entries has 3"),
    "one word": (
        with_key("train", "seed=0"),
        "lnn.train is 'seed=0', expected a list, each a text",
    ),
    "numbers": (with_key("evaluate", [1]), r"lnn.evaluate is \[1\], expected a list"),
    "no time": (with_key("minutes", float("nan")), "lnn.minutes is nan, expected a number above 0"),
    "results elsewhere": (with_key("results", "/etc/*"), "results is '/etc/\\*', expected files"),
    "an unknown key": (with_key("metrik", "x"), "takes no 'metrik': did you mean metric"),
    "no such run": (
        with_key("runs", ["b"], "control/a"),
        "runs has 'b', expected entries above it",
    ),
}


def listed(tmp_path, entries, *words):
    path = tmp_path / "entries.yaml"
    text = entries if isinstance(entries, bytes) else yaml.safe_dump({"entries": entries}).encode()
    path.write_bytes(text if entries else b"{}" if entries == {} else text)
    reproduce.main(["--entries", str(path), "--folder", str(tmp_path / "out"), *words])


@pytest.mark.parametrize(("entries", "says"), BROKEN.values(), ids=BROKEN)
def test_a_list_that_cannot_be(tmp_path, entries, says):
    with pytest.raises(SystemExit, match=f"^Error: .*entries.yaml.*{says}"):
        listed(tmp_path, entries)
    assert not (tmp_path / "out").exists()


def test_a_good_list(tmp_path, capsys):
    listed(tmp_path, GOOD, "--list")
    assert "control/a" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--entries", "nowhere"], "nowhere cannot be read"),
        (["--entries", "."], "cannot be read"),
        (["--only", "pnda/lnn"], "no entry pnda/lnn: did you mean panda/lnn"),
        (["--only", "panda/lnn", "--folder", "/dev/null"], "--folder is /dev/null, which cannot"),
    ],
)
def test_words(monkeypatch, words, says):
    monkeypatch.setattr(reproduce, "call", None)  # which would end in another error
    with pytest.raises(SystemExit, match=says):
        reproduce.main(words)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        (b"", "t.csv cannot be read"),
        (b"\xff\xfe", "cannot be read"),
        (b"a\n1\n", "no column 'model'"),
    ],
)
def test_a_damaged_table(tmp_path, table, says):
    (tmp_path / "t.csv").write_bytes(table)
    with pytest.raises(ConfigError, match=says):
        reproduce.selected({"select": {"model": "lnn"}}, [tmp_path / "t.csv"])


def test_a_training_that_leaves_nothing(monkeypatch):
    monkeypatch.setattr(reproduce, "call", lambda *words: None)
    with pytest.raises(reproduce.EntryError, match="left no finished training"):
        reproduce.run("a/lnn", TRAINS, Path("out"))


@pytest.mark.parametrize("folder", ["my runs", "a,b=[c]", "it's {x}", "é", "plain/a-1"])
def test_any_folder_is_a_value(folder):
    word = f"hydra.sweep.dir={reproduce.quoted(Path(folder))}"
    assert parsed([word])[0].value() == folder
