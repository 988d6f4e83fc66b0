"""Robots with a joint without a motor: no constant collapses, and the defaults find all of them."""

from functools import partial

import pytest
import torch

import pinn_dyn
from pinn_dyn.data import draw_windows
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares
from tests.support.underactuated import ACROBOT, CART_POLE, PENDUBOT, fitted_constants, log

ROBOTS = {"cart-pole": CART_POLE, "pendubot": PENDUBOT, "acrobot": ACROBOT}


def builder(arm):
    return partial(
        KnownMechanics,
        structure=RigidChain(arm.urdf),
        friction=CoulombFriction,
        driven_joints=[arm.driven],
    )


def assert_found(arm, model, error):
    for name, value in fitted_constants(arm, model).items():
        assert value == pytest.approx(arm.constants[name], rel=error), name


@pytest.mark.parametrize("name", ROBOTS)
def test_a_joint_without_a_motor_does_not_collapse(name):
    """Zero bodies would explain zero torque. Noise of the motion biases the acrobot most."""
    arm = ROBOTS[name]
    runs = []
    for _, run in log(arm, 2).groupby("run"):
        t, q, v, u = (
            torch.from_numpy(run[columns].to_numpy().copy())
            for columns in ("t", ["q1", "q2"], ["v1", "v2"], ["u"])
        )
        runs.append(Trajectory(q, v, Signal(t, u)))
    windows = draw_windows(runs, count=40, steps=1, stride=4, seed=0)
    model = builder(arm)(statistics=windows.statistics())
    LeastSquares(cutoff=10.0, rollouts=False, samples=800).fit(model, runs)
    assert_found(arm, model.double(), 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_the_defaults_find_the_constants(name):
    arm = ROBOTS[name]
    run = pinn_dyn.fit(
        log(arm, 6),
        q=["q1", "q2"],
        v=["v1", "v2"],
        u=["u"],
        run="run",
        model=builder(arm),
        optimizer=LeastSquares(cutoff=6.0),
    )
    assert_found(arm, run.model.double(), 0.1)
