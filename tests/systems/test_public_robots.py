"""The robots of the package example-robot-data against Pinocchio."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from pinn_dyn.systems import RigidChain
from tests.support.contracts import slow_except

pinocchio = pytest.importorskip("pinocchio", reason="the dev extra is not installed")
FOLDER = Path(importlib.util.find_spec("pinocchio").origin).parents[4]
FOLDER = FOLDER / "share" / "example-robot-data" / "robots"
WITHOUT_JOINTS = {"quadrotor_base", "iris_simple", "ur3"}
FILES = sorted(path for path in FOLDER.rglob("*.urdf") if path.stem not in WITHOUT_JOINTS)
pytestmark = pytest.mark.skipif(not FILES, reason="example-robot-data is not installed")


def test_there_are_66_robots():
    assert len(FILES) >= 66


# Every sixth in turn, all with make test-slow.
@pytest.mark.parametrize("path", slow_except(FILES, FILES[::6]), ids=lambda path: path.stem)
def test_a_robot_has_the_terms_that_it_has_in_pinocchio(path):
    """All joints free, also those that mimic others, in the order of Pinocchio."""
    model = pinocchio.buildModelFromUrdf(str(path))
    names = list(model.names)[1:]
    chain = RigidChain(str(path), joints=names)
    q = np.random.default_rng(0).uniform(-1, 1, len(names))
    pairs = zip(q, list(model.joints)[1:], strict=True)
    values = [[x] if item.nq == 1 else [np.cos(x), np.sin(x)] for x, item in pairs]
    data, state = model.createData(), np.concatenate(values)
    mass = np.triu(pinocchio.crba(model, data, state))
    gravity = pinocchio.computeGeneralizedGravity(model, data, state)
    at = torch.from_numpy(q)
    scale = np.abs(mass).max()
    np.testing.assert_allclose(np.triu(chain.mass_matrix(at)), mass, rtol=0, atol=1e-9 * scale)
    scale = max(np.abs(gravity).max(), 1e-9)
    np.testing.assert_allclose(chain.potential_force(at), gravity, rtol=0, atol=1e-9 * scale)
    assert torch.linalg.eigvalsh(RigidChain(str(path)).generic_inertia()).min() > 0
