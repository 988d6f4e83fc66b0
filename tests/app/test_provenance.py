"""Where the reports of evaluate.py and control.py say that their numbers come from."""

from pinn_dyn.app.build import build_source
from pinn_dyn.app.provenance import data_hash, provenance
from pinn_dyn.app.run_folder import read_config
from pinn_dyn.app.words import command_line


def test_the_hash_of_a_simulation_is_that_of_its_cache_file(hnn_run, cache):
    config = read_config(hnn_run)
    key = data_hash(build_source(config)).split()[0]
    assert (cache / f"soft_arm_1-{key}.npz").is_file()
    config["dataset"]["seed"] = 1
    assert data_hash(build_source(config)).split()[0] != key


def test_the_command_line_can_be_pasted_into_a_shell(monkeypatch):
    monkeypatch.setattr("sys.argv", ["/somewhere/evaluate.py", "runs=[a b,c]", "horizon=5"])
    assert command_line() == "python evaluate.py 'runs=[a b,c]' horizon=5"
    monkeypatch.setattr("sys.argv", ["/venv/bin/pinn-dyn-evaluate", "runs=[a]"])
    assert command_line() == "pinn-dyn-evaluate 'runs=[a]'"


def test_uncommitted_changes_are_reported(monkeypatch):
    answers = {"rev-parse": "abc1234", "status": " M pinn_dyn/app/run_folder.py"}
    monkeypatch.setattr("pinn_dyn.app.provenance._git", lambda *arguments: answers[arguments[0]])
    assert provenance()["uncommitted_changes"] == "yes"
    answers["status"] = ""
    assert provenance()["uncommitted_changes"] == "no"
    answers["rev-parse"] = ""
    record = provenance()
    assert (record["commit"], record["uncommitted_changes"]) == ("unknown", "unknown")
