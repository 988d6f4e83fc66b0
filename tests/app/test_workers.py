"""Workers end with the process that they work for."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.app.entry import NO_FIGURES, TINY, fork_script
from tests.support.processes import alive

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="processes are seen in /proc")

SCRIPT = """
import multiprocessing, os, sys, time
from concurrent.futures import ProcessPoolExecutor
from pinn_dyn.worker_processes import end_with_parent

def begin(parent, late):
    if late:
        print(os.getpid(), flush=True)
        while os.getppid() == parent:
            time.sleep(0.01)
        end_with_parent()
    else:
        end_with_parent()
        print(os.getpid(), flush=True)

if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    given = (os.getpid(), sys.argv[1] == "late")
    with ProcessPoolExecutor(1, context, begin, given) as pool:
        pool.submit(time.sleep, 600).result()
"""


def gone(alive, seconds):
    """Whether nothing is alive any more, after so many seconds at most."""
    until = time.monotonic() + seconds
    while alive() and time.monotonic() < until:
        time.sleep(0.1)
    return not alive()


@pytest.mark.parametrize("moment", ["before", "late"])
def test_a_worker_whose_parent_is_killed_ends(tmp_path, moment):
    """Whether it watched before, or begins to when its parent is dead already."""
    script = tmp_path / "parent.py"
    script.write_text(SCRIPT)
    command = [sys.executable, str(script), moment]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        worker = int(parent.stdout.readline())
        parent.kill()
    assert gone(Path(f"/proc/{worker}").exists, seconds=60)


def workers_of(session):
    """Those of joblib that have not ended."""
    found = []
    for pid in alive(session):
        with contextlib.suppress(OSError):  # it has ended
            if b"LokyProcess" in Path(f"/proc/{pid}/cmdline").read_bytes():
                found.append(pid)
    return found


@pytest.mark.slow
def test_a_killed_sweep_leaves_no_process(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    words = ["-m", *TINY, NO_FIGURES, "model=lnn", "seed=0,1", "hydra.sweep.dir=sweep"]
    words += ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "trainer.steps=400"]
    with (tmp_path / "log.txt").open("w") as output:
        at = dict(folder=tmp_path, output=output, own_session=True)
        process = fork_script("train.py", *words, **at)
        while len(workers_of(process.pid)) < 2 and process.is_alive():
            time.sleep(0.02)
        time.sleep(0.5)
        assert len(workers_of(process.pid)) == 2
        process.kill()
        process.join()
    try:
        assert gone(lambda: alive(process.pid), seconds=10)
    finally:
        for pid in alive(process.pid):
            os.kill(pid, signal.SIGKILL)
