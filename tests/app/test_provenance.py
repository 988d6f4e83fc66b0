"""Origin of the numbers in the reports of evaluate.py and control.py."""

import pinn_dyn
from pinn_dyn.app.provenance import data_hash, provenance
from pinn_dyn.data import data_identity
from tests.app.entry import TINY_DATA


def test_the_hash_of_data_depends_on_their_numbers_alone():
    settings = dict(word[8:].split("=") for word in TINY_DATA)

    def hash_of(**more):
        return data_hash(data_identity(pinn_dyn.dataset("soft_arm_1", **settings, **more)))

    assert hash_of() == hash_of() != hash_of(seed=1)


def test_uncommitted_changes_are_reported(monkeypatch):
    answers = {"rev-parse": "abc1234", "status": " M pinn_dyn/app/run_folder.py"}
    monkeypatch.setattr("pinn_dyn.app.provenance._git", lambda *arguments: answers[arguments[0]])
    assert provenance()["uncommitted_changes"] == "yes"
    answers["status"] = ""
    assert provenance()["uncommitted_changes"] == "no"
    answers["rev-parse"] = ""
    record = provenance()
    assert (record["commit"], record["uncommitted_changes"]) == ("unknown", "unknown")
