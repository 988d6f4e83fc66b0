"""Files of a run folder that are no files: none makes a command wait."""

import os
import shutil

import pytest

from pinn_dyn import atomic_files
from pinn_dyn.app.gather import read_runs, read_test_errors
from pinn_dyn.data import StoredSource
from pinn_dyn.identification.constants import read_constants
from pinn_dyn.run.configuration.validation import ConfigError
from pinn_dyn.run.run_folder import load_run


def as_pipe(path):
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def as_huge(path):
    """Make a file sparse: it takes no room."""
    path.touch()
    os.truncate(path, atomic_files._LARGEST + 1)


def as_device(path):
    path.unlink(missing_ok=True)
    path.symlink_to("/dev/zero")


@pytest.fixture(params=[as_pipe, as_huge, as_device])
def replace(request):
    return request.param


@pytest.mark.parametrize("name", ["config.yaml", "metrics.json", "error.txt"])
def test_a_table_of_runs_leaves_such_a_run_out(tmp_path, lnn_run, replace, name):
    runs = tmp_path / "runs"
    shutil.copytree(lnn_run, runs / "good")
    bad = shutil.copytree(lnn_run, runs / "bad")
    if name == "error.txt":
        (bad / "metrics.json").unlink()
    replace(bad / name)
    table, _, problems = read_runs([str(runs)])
    assert [*table["folder"]] == [str(runs / "good")]
    assert [*problems] == [str(bad)]


def test_test_errors_and_constants_are_regular_files(tmp_path, replace):
    for name in ("summary.csv", "constants.csv"):
        replace(tmp_path / name)
    with pytest.raises(ValueError, match="expected a regular file"):
        read_test_errors(["run"], [str(tmp_path)])
    if replace is as_huge:
        with pytest.raises(ValueError, match="expected a regular file"):
            read_constants({"run": tmp_path})
    else:
        assert read_constants({"run": tmp_path}) == {}


def test_a_checkpoint_is_a_regular_file(tmp_path, lnn_run):
    run = shutil.copytree(lnn_run, tmp_path / "run")
    as_pipe(run / "checkpoints" / "best.ckpt")
    with pytest.raises(ConfigError, match="does not exist"):
        load_run(run)


def test_stored_trajectories_are_a_regular_file(tmp_path):
    as_pipe(tmp_path / "trajectories.pt")
    with pytest.raises(ValueError, match="not a regular file"):
        StoredSource(str(tmp_path / "trajectories.pt"), "x", ["q"], ["u"]).load()
