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
from tests.app.entry import NO_FIGURES, run_script
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


@pytest.mark.slow
def test_a_permuted_log_is_checked_trained_and_evaluated_by_the_commands(frame, tmp_path):
    frame.to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "arm.urdf").write_text(TREE)
    dataset = [
        *("dataset=csv_log", f"dataset.root='{tmp_path}'", "dataset.files=log.csv"),
        *("dataset.q.columns=[q_bend,q_turn,q_slide]", "dataset.q.unit=[rad,rad,m]"),
        *("+dataset.v.columns=[v_bend,v_turn,v_slide]", "dataset.v.unit=[rad/s,rad/s,m/s]"),
        *("dataset.u.columns=[u_slide,u_bend,u_turn]", "dataset.u.unit=[N,Nm,Nm]"),
        *("+dataset.validation.seconds=2.0", "dataset.validation.piece=1.0"),
        *("+dataset.test.seconds=2.0", "dataset.test.piece=1.0"),
    ]
    structure = ["model/structure=urdf", f"model.structure.urdf={tmp_path / 'arm.urdf'}"]
    run_script("check.py", *dataset, *structure, f"hydra.run.dir={tmp_path / 'check'}")
    fit = ["model=known", "data=multi_step", "data.pairs=100", "data.batch_size=100", NO_FIGURES]
    fit += ["optimizer=least_squares", "optimizer.rollouts=false", "validator.horizon=0.5"]
    run_script("train.py", *dataset, *structure, *fit, f"hydra.run.dir={tmp_path / 'run'}")
    evaluation = [f"runs=[{tmp_path / 'run'}]", "horizon=0.5", "windows=[0.1]"]
    run_script("evaluate.py", *evaluation, f"hydra.run.dir={tmp_path / 'evaluation'}")
    table = pd.read_csv(tmp_path / "evaluation" / "summary.csv")
    (row,) = table[~table.baseline & table.model.str.startswith("known")].to_dict("records")
    assert row["error_mean"] < 0.02
