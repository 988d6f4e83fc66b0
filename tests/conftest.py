"""Settings for all tests."""

import pytest
import torch

from tests.support.compositions import keep_compositions

# The tests' tensors are small: threads beyond one only slow them down.
torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def _kept_compositions():
    with pytest.MonkeyPatch.context() as patch:
        keep_compositions(patch)
        yield


@pytest.fixture
def traced(monkeypatch):
    """Programs that are traced and decomposed as ever, but not built: that takes far longer.

    Each kind of program is built by one test.
    """
    monkeypatch.setattr("pinn_dyn.mechanics.compilation._compile", lambda function, _: function)
