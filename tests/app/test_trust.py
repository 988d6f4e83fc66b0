"""Classes of a user's own in a run folder: built where ``trust=`` names their package."""

import re

import pytest

from pinn_dyn.app.config import CONF
from pinn_dyn.run.configuration import trust
from pinn_dyn.run.configuration.validation import ConfigError
from pinn_dyn.run.run_folder import load_run
from tests.app.entry import run_script
from tests.support.foreign_runs import foreign

OWN = """
import os, pathlib
from pinn_dyn.systems import SoftArm

class MyArm(SoftArm):
    pass
"""


@pytest.fixture
def my_package(tmp_path, monkeypatch):
    (tmp_path / "my_arms.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("my_package")
def test_an_own_class_is_built_where_its_package_is_trusted(tmp_path, lnn_run):
    def change(config):
        config["dataset"]["system"]["_target_"] = "my_arms.MyArm"

    run = foreign(lnn_run, tmp_path / "run", change)
    with pytest.raises(ConfigError, match="add trust=") as error:
        load_run(run, "best")
    package = re.search(r"add trust=(\w+) ", str(error.value))[1]
    assert load_run(run, "best", (package,)).folder == run
    for name in ("my", "my_arm", "other"):
        with pytest.raises(ConfigError, match="may name the classes"):
            load_run(run, "best", (name,))


@pytest.mark.usefixtures("my_package")
@pytest.mark.parametrize("target", ["my_arms.os.system", "my_arms.pathlib.Path", "my_arms.SoftArm"])
def test_trust_ends_where_the_package_ends(target):
    assert not trust.may_build(target, ("my_arms",))


@pytest.mark.usefixtures("my_package", "undrawn")
def test_trust_is_given_on_the_command_line(tmp_path, monkeypatch, lnn_run):
    monkeypatch.chdir(tmp_path)

    def change(config):
        config["dataset"]["system"]["_target_"] = "my_arms.MyArm"
        config["trust"] = "my_arms"  # of no use there

    run = foreign(lnn_run, tmp_path / "run", change)
    with pytest.raises(ConfigError, match="trust=my_arms"):
        load_run(run, "best")
    given = ["trust=my_arms", "horizon=0.1", "windows=[]", "hydra.run.dir=out"]
    run_script("evaluate.py", f"runs=[{run}]", *given)
    assert (tmp_path / "out" / "summary.csv").is_file()


def test_everything_that_conf_names_may_be_built():
    """So a run of our own configurations is never refused."""
    texts = [path.read_text() for path in CONF.rglob("*.yaml")]
    names = {x for text in texts for x in re.findall(r"_target_: ([\w.]+)", text)}
    # In no run's configuration: one of Hydra.
    names -= {"pinn_dyn.app.sweep.SweepCallback"}
    names = {x for x in names if not x.startswith("hydra")}
    assert len(names) > 50
    assert not [name for name in sorted(names) if not trust.may_build(name, ())]
