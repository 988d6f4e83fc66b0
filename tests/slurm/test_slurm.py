"""A sweep on a real SLURM of one node, which is started for the test: make test-slurm."""

import json
import os
import shutil
import subprocess
import sys
from importlib.util import find_spec

import pytest

from tests.app.entry import NO_FIGURES, ROOT, TINY

SCRIPT = ROOT / "tests" / "support" / "slurm.sh"
NEEDED = ("slurmctld", "slurmd", "munged")
PATH = f"{os.environ['PATH']}:/usr/sbin"


def missing():
    """What keeps SLURM from being started here."""
    programs = [name for name in NEEDED if shutil.which(name, path=PATH) is None]
    if programs:
        return f"no {', '.join(programs)}: apt-get install slurm-wlm munge"
    if os.geteuid() != 0:
        return "SLURM is started as root"
    if find_spec("hydra_plugins.hydra_submitit_launcher") is None:
        return "needs hydra-submitit-launcher (the sweeps extra)"
    return None


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(missing() is not None, reason=str(missing())),
]


@pytest.fixture
def slurm(tmp_path):
    """A SLURM of one node; gives the environment in which its commands find it."""
    folder = tmp_path / "slurm"
    subprocess.run([SCRIPT, "start", folder], check=True, timeout=200)
    try:
        # The jobs do not know the folder of train.py, should the package not be installed.
        yield {**os.environ, "SLURM_CONF": str(folder / "slurm.conf"), "PYTHONPATH": str(ROOT)}
    finally:
        subprocess.run([SCRIPT, "stop", folder], check=True, timeout=200)


def sweep(environment, folder, *arguments):
    return subprocess.run(
        [
            *(sys.executable, str(ROOT / "train.py"), "-m", *TINY, NO_FIGURES),
            *("hydra/launcher=slurm", "hydra.launcher.mem_gb=1", "hydra.sweep.dir=sweep"),
            *arguments,
        ],
        cwd=folder,
        env={**environment, "PINN_DYN_CACHE": str(folder / "cache"), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )


def test_a_sweep_runs_as_slurm_jobs_and_lists_the_one_that_failed(slurm, tmp_path):
    choices = ["model=lnn", "optimizer.lr=0.005,1e9"]  # the last one diverges
    done = sweep(slurm, tmp_path, *choices)
    said = done.stdout + done.stderr
    assert done.returncode == 1, said
    assert "1 job failed:\n  sweep/1_lnn-seed0\n    NonFiniteLossError: " in said
    record = json.loads((tmp_path / "sweep" / "0_lnn-seed0" / "metrics.json").read_text())
    assert record["validation"]["val/error_mean"] > 0
    # SLURM ran them: it numbered the jobs, and its own log of each is there.
    assert len(list((tmp_path / "sweep" / ".submitit").glob("*_[01]/*_log.out"))) == 2
    assert len(list((tmp_path / "cache").glob("*.npz"))) == 1

    again = sweep(slurm, tmp_path, *choices)
    logs = "".join(path.read_text() for path in (tmp_path / "sweep").glob("*/train.log"))
    assert again.returncode == 1, again.stdout + again.stderr
    assert logs.count("already trained") == 1
