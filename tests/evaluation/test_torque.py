"""Torque errors against pendulums whose torques are known."""

import math

import numpy as np
import pytest
import torch

from pinn_dyn.evaluation import torque_error
from pinn_dyn.evaluation.torque import part_shares, residual_share
from pinn_dyn.mechanics import Signal, Sum, Trajectory
from tests.support.linear import Pendulums


def pendulum(damping=0.5, motors=2, factor=1.0, kind=Pendulums):
    """2 a + d v + 3 sin q = u for each of two joints; the second has no motor if told so."""
    terms = (np.eye(2) * factor * x for x in (2.0, 3.0, damping))
    return kind(*terms, factor * np.eye(2)[:, :motors])


def motion(motors=2, step=0.01):
    """q = sin(w t) in either joint, and the torque of the standard pendulum that makes it."""
    t = step * torch.arange(round(4 / step) + 1, dtype=torch.float64)
    w = torch.tensor([2.0, 3.0], dtype=torch.float64)
    q, v, a = (f(w * t[:, None]) for f in (torch.sin, torch.cos, torch.sin))
    v, a = w * v, -(w**2) * a
    u = 2.0 * a + 0.5 * v + 3.0 * torch.sin(q)
    return Trajectory(q[None], v[None], Signal(t, u[None, :, :motors])), v, u


def test_the_true_model_has_no_torque_error():
    truth, _, _ = motion()
    found = torque_error(pendulum(), truth, system=pendulum())
    assert found.mean < 1e-9
    assert found.share < 1e-9


def test_a_wrong_damping_errs_by_its_share_of_the_velocity():
    truth, v, u = motion()
    for system, tolerance in ((pendulum(), 1e-6), (None, 2e-3)):  # the slope of v by a polynomial
        found = torque_error(pendulum(damping=0.7), truth, system=system)
        rms = 0.2 * v.square().mean(0).sqrt()
        torch.testing.assert_close(found.rms, rms, rtol=tolerance, atol=tolerance)
        spread = u.std(dim=0, correction=0)
        torch.testing.assert_close(found.spread, spread, rtol=1e-6, atol=1e-6)
        assert found.share == pytest.approx(float(rms.norm() / spread.norm()), rel=tolerance)
        assert found.mean == pytest.approx(0.2 * float(v.norm(dim=-1).mean()), rel=tolerance)


def test_a_common_factor_of_all_terms_does_not_change_the_share():
    truth, _, _ = motion()
    one, ten = (
        torque_error(pendulum(damping=0.7, factor=f), truth, system=pendulum()) for f in (1, 10)
    )
    assert ten.share == pytest.approx(one.share, rel=1e-9)
    assert ten.mean == pytest.approx(10 * one.mean, rel=1e-9)


class Leaky(Pendulums):
    """Pendulum with the residual force 0.4 v."""

    has_residual = True

    def _residual_force(self, q, v, u):
        return 0.4 * v


def test_the_residual_share_is_relative_to_both_forces():
    truth, v, u = motion()
    residual, applied = (x.square().sum(-1).mean().sqrt() for x in (0.4 * v, u))
    expected = float(residual / (residual + applied))
    assert residual_share(pendulum(kind=Leaky), truth) == pytest.approx(expected, rel=1e-6)


def test_each_part_of_a_sum_has_its_share_of_each_term():
    """Three times the mass, damping and stiffness make three quarters of the force."""
    truth, v, _ = motion()
    parts = {"light": pendulum(), "heavy": pendulum(factor=3.0)}
    table = part_shares(Sum(parts), truth).set_index(["part", "term"])
    damping = float((0.5 * v).square().sum(-1).mean().sqrt())
    assert table.loc[("light", "D v + F"), "rms"] == pytest.approx(damping, rel=1e-6)
    assert table.loc["light", "share"].tolist() == pytest.approx([0.25] * 3)
    assert table.loc["heavy", "share"].tolist() == pytest.approx([0.75] * 3)


def test_a_joint_without_a_motor_has_no_share_but_counts():
    truth, _, _ = motion(motors=1)
    found = torque_error(pendulum(motors=1), truth, system=None)
    frame = found.to_frame(["shoulder", "elbow"])
    assert frame["joint"].tolist() == ["shoulder", "elbow"]
    assert frame["torque_share"].isna().tolist() == [False, True]
    assert found.spread[1] == 0
    # The motion of the second joint needs a torque, which nobody applies.
    assert found.rms[1] > 0.5
    assert math.isfinite(found.share)


def test_accelerations_need_samples_at_a_constant_step():
    truth, _, _ = motion()
    with pytest.raises(ValueError, match="3 samples"):
        torque_error(pendulum(), truth.until(0.02), system=None)
    uneven = Trajectory(truth.q, truth.v, Signal(truth.t**2, truth.u))
    with pytest.raises(ValueError, match="accelerations need at least 5 at a constant step"):
        torque_error(pendulum(), uneven, system=None)
