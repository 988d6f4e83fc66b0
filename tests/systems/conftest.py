import pytest

from pinn_dyn.systems import MujocoArm
from tests.support.simulated_arms import FINGERS, PANDA, PENDULUM


@pytest.fixture
def pendulum(tmp_path):
    """Writes the pendulum's URDF, changed by (old, new) pairs, and gives its path."""

    def write(*changes):
        text = PENDULUM
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "pendulum.urdf"
        path.write_text(text)
        return str(path)

    return write


@pytest.fixture(scope="module")
def panda():
    return MujocoArm(PANDA, locked_joints=FINGERS, damping=0.5)
