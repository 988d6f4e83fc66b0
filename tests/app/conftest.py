"""One cache and a few tiny runs for all tests of the entry points."""

import functools
from importlib.metadata import entry_points

import pytest

from tests.app.entry import NO_FIGURES, train


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory):
    """All runs share the cached tiny data sets."""
    folder = tmp_path_factory.mktemp("cache")
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
def hnn_run(tmp_path_factory):
    """A Hamiltonian network, two epochs."""
    folder = tmp_path_factory.mktemp("runs") / "hnn"
    return train(folder, "model=hnn", "trainer.steps=4", "trainer.validations=2", NO_FIGURES)


@pytest.fixture(scope="session")
def lnn_run(tmp_path_factory):
    """A Lagrangian network."""
    return train(tmp_path_factory.mktemp("runs") / "lnn", "model=lnn", NO_FIGURES)


@pytest.fixture(scope="session")
def mlp_run(tmp_path_factory):
    """The paper's black box."""
    return train(tmp_path_factory.mktemp("runs") / "mlp", "model=mlp", NO_FIGURES)
