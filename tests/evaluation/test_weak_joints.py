"""Joints that a fit cannot predict are named with the cause."""

import dataclasses

import numpy as np
import pytest
import torch

from pinn_dyn.identification.constants import weak_joints
from pinn_dyn.mechanics import Signal
from tests.support.known import known_model, motions


@pytest.mark.parametrize(("noise", "cause"), [(0.0, None), (60.0, "the noise of its torque")])
def test_noise_of_a_torque_is_named(noise, cause):
    model = known_model(friction=None)
    runs = motions(model, range(2), seconds=3.0)
    generator = np.random.default_rng(0)

    def noisy(run):
        u = run.u.clone()
        u[:, 1] += torch.from_numpy(noise * generator.normal(size=len(u)))
        return dataclasses.replace(run, input=Signal(run.t, u))

    lines = weak_joints(model, [noisy(run) for run in runs], 6.0, ["a", "b", "c"])
    assert [line.partition(":")[0] for line in lines] == ["b"] * bool(cause)
    assert all(cause in line for line in lines)


def test_motion_that_is_slower_than_unknown_forces_is_named():
    model = known_model(friction=None)
    runs = motions(model, range(2), seconds=3.0)

    def disturbed(run):
        u = run.u.clone()
        u[:, 0] += 100 * torch.sin(2 * torch.pi * run.t)
        return dataclasses.replace(run, input=Signal(run.t, u))

    (line,) = weak_joints(model, [disturbed(run) for run in runs], 6.0, ["a", "b", "c"])
    assert line.startswith("a: ")
    assert line.endswith("the motion is too slow")
