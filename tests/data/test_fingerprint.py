"""The fingerprint of data: an edited equation, a changed list, another file are other data."""

import itertools
import json
import shutil
import sys

import numpy as np
import pytest
import torch

from pinn_dyn.data import Splits, fingerprint_changes, moments, same_moments
from pinn_dyn.data.fingerprint import describe
from pinn_dyn.data.logs import Butterworth, MovingAverage
from pinn_dyn.systems import SoftArm
from tests.data.logs_files import motion, source, write

MODULE = '''
"""A pendulum on a spring."""
import math
import torch
from pinn_dyn.mechanics import MechanicalSystem

LENGTHS = [0.3, 0.4]

def weight(q):
    """Acts downwards."""
    return 9.81 * q.cos()  # J

class Pendulum(MechanicalSystem):
    """One joint."""
    damping = 0.1

    def __init__(self, masses=(1.0, 2.0)):
        super().__init__(1, 1)
        self.masses = list(masses)

    def mass_matrix(self, q):
        return (sum(self.masses) * LENGTHS[0] ** 2 * torch.ones_like(q))[..., None]

    def potential_energy(self, q):
        return -weight(q)[..., 0]

    def damping_matrix(self, q):
        return self.damping * torch.ones_like(q)[..., None]

    def input_matrix(self, q):
        return torch.ones_like(q)[..., None]
'''
names = (f"pendulum_of_test_{k}" for k in itertools.count())


def pendulum(tmp_path, monkeypatch, *edits, **arguments):
    """The user's system, its file as edited, imported as a new process would import it."""
    text = MODULE
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    folder = tmp_path / next(names)
    folder.mkdir()
    (folder / "my_pendulum.py").write_text(text)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "my_pendulum", raising=False)
    import my_pendulum

    return json.dumps(describe(my_pendulum.Pendulum(**arguments)))


@pytest.mark.parametrize(
    "edit",
    [
        ("LENGTHS[0] ** 2", "LENGTHS[0] ** 3"),
        ("-weight(q)", "weight(q)"),
        ("9.81", "1.62"),
        ("q.cos()", "q.sin()"),
        ("LENGTHS = [0.3, 0.4]", "LENGTHS = [0.3, 0.5]"),
        ("damping = 0.1", "damping = 0.2"),
    ],
    ids=lambda edit: edit[1],
)
def test_an_edited_equation_is_another_system(tmp_path, monkeypatch, edit):
    before = pendulum(tmp_path, monkeypatch)
    assert pendulum(tmp_path, monkeypatch, edit) != before


def test_a_changed_list_is_another_system(tmp_path, monkeypatch):
    before = pendulum(tmp_path, monkeypatch)
    assert pendulum(tmp_path, monkeypatch, masses=[1.0, 2.5]) != before


def test_comments_docstrings_and_another_run_are_the_same_system(tmp_path, monkeypatch):
    before = pendulum(tmp_path, monkeypatch)
    assert pendulum(tmp_path, monkeypatch) == before
    edits = (
        ("  # J", "  # the potential, in J"),
        ('"""Acts downwards."""', '"""Down."""'),
        ('    """One joint."""\n', '    """A joint."""\n\n'),
    )
    assert pendulum(tmp_path, monkeypatch, *edits) == before


def test_a_class_written_in_a_session_without_a_file(tmp_path):
    def run(factor):
        scope = {"__name__": "__main__"}
        exec(f"class Spring:\n    def force(self, q):\n        return {factor} * q\n", scope)
        return describe(scope["Spring"]())

    assert run(2.0) == run(2.0) != run(3.0)


def test_settings_and_constants_of_any_depth_are_seen():
    class Part:
        def __init__(self, **values):
            self.__dict__.update(values)

    def one(**changes):
        values = dict(a=[1, {"b": (2.0, None)}], c=np.eye(9), d=Part(e={"f"}), g=torch.ones(3))
        return describe(Part(**{**values, **changes}))

    json.dumps(one(), allow_nan=False)
    assert one() == one()
    for change in (
        dict(a=[1, {"b": (2.0, 0)}]),
        dict(c=np.eye(9) * 2),
        dict(d=Part(e={"h"})),
        dict(g=torch.ones(4)),
        dict(a=[1, {"b": (float("nan"), None)}]),
    ):
        assert one(**change) != one()


def test_what_says_nothing_of_itself_is_refused_by_name():
    with pytest.raises(TypeError, match=r"_thread.lock does not say .* method describe\(\)"):
        describe([__import__("threading").Lock()])


def test_our_own_robots_are_known_by_their_code():
    assert describe(SoftArm()) == describe(SoftArm().eval()) != describe(SoftArm(mass=[0.31]))
    assert describe(SoftArm())["class"].startswith("SoftArm ")


# Logs.


@pytest.fixture
def folder(tmp_path):
    for k in range(4):
        write(tmp_path, motion(4.0, phase=0.7 * k), f"run_{k}.csv")
    return tmp_path


def runs(folder, **changes):
    parts = dict(validation=dict(runs=["run_2"], piece=1.0), test=dict(runs=["run_3"], piece=1.0))
    return source(folder, **{**parts, **changes})


def changes(folder, **settings):
    return fingerprint_changes(folder_before(folder), runs(folder, **settings).fingerprint())


def folder_before(folder):
    return json.loads((folder / "fingerprint.json").read_text())


@pytest.fixture
def recorded(folder):
    (folder / "fingerprint.json").write_text(json.dumps(runs(folder).fingerprint()))
    return folder


def test_a_copy_of_the_logs_elsewhere_is_the_same(recorded, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("copy") / "logs"
    shutil.copytree(recorded, elsewhere)
    assert changes(elsewhere) == []


def test_files_that_came_went_and_changed_are_named(recorded):
    table = motion(4.0, phase=5.0)
    write(recorded, table, "run_4.csv")
    text = "\n".join(changes(recorded))
    assert "file run_4.csv was added" in text
    assert "run_4 (0 to 4 s), 401 rows is new in " in text
    (recorded / "run_4.csv").unlink()
    table = motion(4.0)
    table.loc[7, "u1"] += 0.25
    write(recorded, table, "run_0.csv")
    (found,) = changes(recorded)
    assert found.startswith("file run_0.csv was edited")
    (recorded / "run_3.csv").rename(recorded / "run_5.csv")
    text = "\n".join(changes(recorded, test=dict(runs=["run_5"], piece=1.0)))
    assert "file run_3.csv is gone" in text
    assert 'test.runs was ["run_3"], now it is ["run_5"]' in text


def test_runs_that_moved_between_splits_are_named(recorded):
    found = changes(recorded, test=dict(runs=["run_0"], piece=1.0))
    assert "run_3 (0 to 4 s), 401 rows moved from test to train" in found
    assert "run_0 (0 to 4 s), 401 rows moved from train to test" in found


def test_another_cleaning_is_named(recorded):
    filtered = dict(smooth=MovingAverage(3, signals=["u"]))
    (found,) = changes(recorded, steps=filtered)
    assert found.startswith('steps.smooth is new: {"class": "MovingAverage')
    (recorded / "fingerprint.json").write_text(
        json.dumps(runs(recorded, steps=filtered).fingerprint())
    )
    filtered = dict(smooth=MovingAverage(5, signals=["u"]))
    assert changes(recorded, steps=filtered) == ["steps.smooth.window was 3, now it is 5"]
    assert changes(recorded, steps=dict(smooth=Butterworth(5.0, signals=["u"])))


def test_edited_code_is_said_as_such():
    before, after = {"system": {"class": "Arm 12ab"}}, {"system": {"class": "Arm 34cd"}}
    assert fingerprint_changes(before, after) == ["the code of system was edited"]


def test_moments_are_those_of_all_samples_and_tell_data_apart(tmp_path):
    write(tmp_path, motion(9.0), "one.csv")
    write(tmp_path, motion(8.0, phase=0.5), "two.csv")
    write(tmp_path, motion(7.5, phase=1.0), "three.csv")
    splits = source(tmp_path).load()
    found = json.loads(json.dumps(moments(splits)))
    every = np.concatenate([item.v.numpy() for item in splits.train])
    assert found["train"]["v"]["mean"] == pytest.approx(every.mean(0))
    assert found["train"]["v"]["std"] == pytest.approx(every.std(0))
    assert same_moments(found, moments(splits))
    assert not same_moments(found, moments(Splits(splits.train, splits.test, splits.validation)))
    without_test = Splits(splits.train, splits.validation, [])
    assert not same_moments(found, moments(without_test))
    assert same_moments(moments(without_test), moments(without_test))
