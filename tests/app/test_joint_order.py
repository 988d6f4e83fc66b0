"""Identification from logs whose columns have another order than the joints of the URDF."""

from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch

import pinn_dyn
from pinn_dyn.models import KnownMechanics, NoFriction
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares
from tests.support.rigid_chains import TREE

JOINTS = ["turn", "slide", "bend"]


@pytest.fixture(scope="module")
def frame():
    """Motions of the tree with two joints held, and the torques of its inverse dynamics."""
    t = np.arange(0, 16, 0.01)
    frequencies = 2 * np.pi * np.array([[0.31, 0.73, 1.13], [0.41, 0.67, 0.97], [0.37, 0.83, 1.21]])
    angles = t[:, None, None] * frequencies + np.arange(9).reshape(3, 3)
    q = (0.4 * np.sin(angles)).sum(-1)
    v = (0.4 * frequencies * np.cos(angles)).sum(-1)
    a = -(0.4 * frequencies**2 * np.sin(angles)).sum(-1)
    chain = RigidChain(TREE, joints=JOINTS, damping=0.5)
    u = chain.inverse_dynamics(*map(torch.from_numpy, (q, v, a))).numpy()
    names = [f"{signal}_{joint}" for signal in "qvu" for joint in JOINTS]
    return pd.DataFrame(np.hstack([q, v, u]), columns=names).assign(t=t)


def fitted(frame, order, inputs, folder=None):
    return pinn_dyn.fit(
        frame,
        q=[f"q_{name}" for name in order],
        v=[f"v_{name}" for name in order],
        u=[f"u_{name}" for name in inputs],
        model=partial(
            KnownMechanics, structure=RigidChain(TREE), start="prior", friction=NoFriction
        ),
        optimizer=LeastSquares(cutoff=8.0, rollouts=False),
        **({} if folder is None else {"folder": folder}),
    )


def test_a_permuted_log_gives_the_same_identification_and_predictions(frame, tmp_path):
    ordered = fitted(frame, JOINTS, JOINTS)
    order, inputs = ["bend", "turn", "slide"], ["slide", "bend", "turn"]
    permuted = fitted(frame, order, inputs, tmp_path / "run")
    structure = permuted.system.structure
    assert (structure.joint_names, permuted.config["model"]["driven_joints"]) == (order, inputs)
    bodies = [run.system.body_parameters() for run in (ordered, permuted)]
    torch.testing.assert_close(bodies[1], bodies[0], rtol=1e-3, atol=1e-4)
    loaded = pinn_dyn.load(tmp_path / "run")
    q = torch.randn(5, 3, generator=torch.manual_seed(0)).double()
    here, there = [JOINTS.index(x) for x in order], [JOINTS.index(x) for x in inputs]
    truth = RigidChain(TREE, joints=JOINTS, damping=0.5)
    expected = truth.forward_dynamics(q, 0.5 * q, 3 * q)[:, here]
    for run in (permuted, loaded):
        found = run.system.forward_dynamics(q[:, here], 0.5 * q[:, here], 3 * q[:, there])
        torch.testing.assert_close(found, expected, rtol=0.02, atol=0.02)
