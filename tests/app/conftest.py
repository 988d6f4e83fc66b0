"""One cache and a tiny run of each kind, made once for all tests and workers of a test run."""

import functools
import os
from importlib.metadata import entry_points

import pytest
from filelock import FileLock

from tests.app.entry import NO_FIGURES, RUNS, train


@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    """Folder of this test run, the same for all its workers."""
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


@pytest.fixture(scope="session", autouse=True)
def cache(shared):
    """All runs share the cached tiny data sets."""
    folder = shared / "cache"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PINN_DYN_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session", autouse=True)
def _kept_entry_points():
    """Lightning asks all installed packages for callbacks at each trainer: most of its set-up."""
    with pytest.MonkeyPatch.context() as patch:
        kept = functools.cache(entry_points)
        patch.setattr("lightning.fabric.utilities.registry.entry_points", kept)
        yield


@pytest.fixture(scope="session")
def run_of(shared):
    """Return the folder of the run of a kind, which the first that asks for it trains."""

    def trained(kind):
        folder = shared / "runs" / kind.replace(" ", "_")
        with FileLock(shared / f"{folder.name}.lock"):
            if not (folder / "metrics.json").is_file():
                train(folder, *RUNS[kind], NO_FIGURES)
        return folder

    return trained


@pytest.fixture(scope="session")
def hnn_run(run_of):
    """A Hamiltonian network, two epochs."""
    return run_of("hnn")


@pytest.fixture(scope="session")
def lnn_run(run_of):
    """A Lagrangian network."""
    return run_of("lnn")


@pytest.fixture(scope="session")
def mlp_run(run_of):
    """The paper's black box."""
    return run_of("mlp")
