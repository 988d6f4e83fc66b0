"""Files of a run folder that are no files: none makes a command wait."""

import os
import shutil

import pytest

from pinn_dyn import atomic_files
from pinn_dyn.app.gather import read_runs, read_test_errors
from pinn_dyn.run.configuration.validation import ConfigError
from pinn_dyn.run.run_folder import load_run


def as_pipe(path):
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def as_huge(path):
    """Make a file sparse: it takes no room."""
    path.touch()
    os.truncate(path, atomic_files._LARGEST + 1)


@pytest.mark.parametrize("replace", [as_pipe, as_huge])
def test_a_table_of_runs_leaves_such_a_run_out(tmp_path, lnn_run, replace):
    runs = tmp_path / "runs"
    shutil.copytree(lnn_run, runs / "good")
    bad = shutil.copytree(lnn_run, runs / "bad")
    replace(bad / "metrics.json")
    table, _, problems = read_runs([str(runs)])
    assert [*table["folder"]] == [str(runs / "good")]
    assert [*problems] == [str(bad)]
    replace(tmp_path / "summary.csv")
    with pytest.raises(ValueError, match="expected a regular file"):
        read_test_errors(["run"], [str(tmp_path)])


def test_a_checkpoint_is_a_regular_file(tmp_path, lnn_run):
    run = shutil.copytree(lnn_run, tmp_path / "run")
    as_pipe(run / "checkpoints" / "best.ckpt")
    with pytest.raises(ConfigError, match="does not exist"):
        load_run(run)
