"""Origin of the numbers in the reports of evaluate.py and control.py."""

import pinn_dyn
from pinn_dyn.app.provenance import data_hash, provenance
from tests.app.entry import TINY_DATA


def test_the_hash_of_data_depends_on_their_numbers_alone():
    settings = dict(word[8:].split("=") for word in TINY_DATA)
    first, again = (data_hash(pinn_dyn.dataset("soft_arm_1", **settings)) for _ in range(2))
    other = data_hash(pinn_dyn.dataset("soft_arm_1", **settings, seed=1))
    assert first == again != other


def test_uncommitted_changes_are_reported(monkeypatch):
    answers = {"rev-parse": "abc1234", "status": " M pinn_dyn/app/run_folder.py"}
    monkeypatch.setattr("pinn_dyn.app.provenance._git", lambda *arguments: answers[arguments[0]])
    assert provenance()["uncommitted_changes"] == "yes"
    answers["status"] = ""
    assert provenance()["uncommitted_changes"] == "no"
    answers["rev-parse"] = ""
    record = provenance()
    assert (record["commit"], record["uncommitted_changes"]) == ("unknown", "unknown")
