"""The helix: its path, the joints that follow it, their derivatives, and what is out of reach."""

import math

import numpy as np
import pytest
import torch

pytest.importorskip("mujoco", reason="the mujoco extra is not installed")

from pinn_dyn.control.helix import Helix
from pinn_dyn.control.references import check_limits
from pinn_dyn.systems import MujocoArm
from pinn_dyn.testing import assert_near, slope

POSTURE = [0.1, -0.3, 0.0, -2.2, 0.0, 2.0, 0.785]
FAST = {"radius": 0.1, "pitch": 0.06, "period": 4.0, "turns": 1.5}


@pytest.fixture(scope="module")
def arm():
    fingers = ("panda_finger_joint1", "panda_finger_joint2")
    return MujocoArm("franka_panda/panda.urdf", locked_joints=fingers)


@pytest.fixture(scope="module")
def helix(arm):
    return Helix(arm, POSTURE, **FAST, rise_time=1.0)


def tip(arm, q):
    return arm.tip_position(q).numpy()


def test_tip_follows_the_path_between_knots_too(arm, helix):
    times = np.random.default_rng(0).uniform(0, helix.duration, 60)
    errors = [np.linalg.norm(tip(arm, helix(t).q) - helix.path(t)) for t in times]
    assert max(errors) < 1e-7
    assert max(errors) < 1.1 * helix.path_error
    check_limits(helix, arm.q_low, arm.q_high, helix.duration, arm.v_max)


def test_path_is_the_helix_of_its_formula(arm, helix):
    start = tip(arm, torch.tensor(POSTURE, dtype=torch.float64))
    np.testing.assert_allclose(helix.path(0.0), start, atol=1e-15)
    centre = start - [0.1, 0, 0]
    assert helix.duration == pytest.approx(1.5 * 4 + 1)
    for t in np.linspace(0, helix.duration, 40):
        x, y, z = helix.path(t) - centre
        assert math.hypot(x, y) == pytest.approx(0.1, abs=1e-14)
        # One pitch each turn, counter-clockwise about z.
        angle = 2 * math.pi * z / 0.06
        circle = [0.1 * math.cos(angle), 0.1 * math.sin(angle)]
        np.testing.assert_allclose([x, y], circle, rtol=0, atol=1e-14)
    # At full speed after the rise, one period is one turn.
    later = helix.path(5.5) - helix.path(1.5)
    np.testing.assert_allclose(later, [0, 0, 0.06], atol=1e-14)
    np.testing.assert_allclose(helix.path(9.0) - start, [-0.2, 0, 0.09], atol=1e-14)


@pytest.mark.parametrize(("axis", "to_centre"), [("x", [0, -1, 0]), ("y", [0, 0, -1])])
def test_path_about_the_other_axes(arm, axis, to_centre):
    helix = Helix(arm, POSTURE, 0.05, -0.04, 2.0, 0.5, axis)
    along = {"x": [1, 0, 0], "y": [0, 1, 0]}[axis]
    expected = 0.1 * np.array(to_centre) - 0.02 * np.array(along)
    np.testing.assert_allclose(helix.path(9.0) - helix.path(0.0), expected, atol=1e-14)
    assert tip(arm, helix(9.0).q) == pytest.approx(helix.path(9.0), abs=1e-9)


def test_derivatives_match_finite_differences(helix):
    for t in (0.2, 0.9, 1.01, 2.345, 4.2, 5.99, 6.3, 6.9, 8.0):
        motion = helix(t)
        assert motion.q.dtype == torch.float64
        assert_near(motion.v, slope(lambda e, t=t: helix(t + e).q), 1e-9, scale=1)
        assert_near(motion.a, slope(lambda e, t=t: helix(t + e).v), 1e-8, scale=1)
        path_speed = slope(lambda e, t=t: torch.from_numpy(helix.path(t + e)))
        if 1 < t < 6:
            speed = 2 * math.pi / 4 * math.hypot(0.1, 0.06 / (2 * math.pi))
            assert float(path_speed.norm()) == pytest.approx(speed, rel=1e-9)


def test_starts_and_stops_at_rest_and_stays(helix):
    np.testing.assert_array_equal(helix(0.0).q, POSTURE)
    for t in (0.0, helix.duration, helix.duration + 5):
        assert not helix(t).v.any()
        assert not helix(t).a.any()
    assert torch.equal(helix(helix.duration).q, helix(helix.duration + 5).q)
    # No jump of the acceleration anywhere.
    a = np.array([helix(t).a.numpy() for t in np.arange(0, helix.duration, 1e-3)])
    assert np.abs(np.diff(a, axis=0)).max() < 0.02 * np.abs(a).max()


def test_the_posture_is_the_nearest_and_a_circle_closes(arm, helix):
    for t in (2.0, 4.7, 7.0):
        q = helix(t).q
        J = torch.autograd.functional.jacobian(arm.tip_position, q).numpy()
        homing = np.array(POSTURE) - q.numpy()
        assert np.linalg.norm(homing) > 0.1
        assert np.linalg.norm(homing - np.linalg.pinv(J) @ J @ homing) < 1e-6
    circle = Helix(arm, POSTURE, 0.08, 0.0, 2.0, 1.0)
    np.testing.assert_allclose(circle(circle.duration).q, POSTURE, atol=1e-9)


@pytest.mark.parametrize("changes", [{"pitch": 2.0}, {"radius": 0.3, "turns": 0.5}])
def test_a_helix_out_of_reach_is_refused_and_a_smaller_one_is_not(arm, changes):
    with pytest.raises(
        ValueError, match=r"the (arm cannot follow|tip misses) the helix.*take a smaller radius"
    ):
        Helix(arm, POSTURE, **{**FAST, **changes})
    smaller = {name: value if name == "turns" else value / 10 for name, value in changes.items()}
    assert Helix(arm, POSTURE, **{**FAST, **smaller}).path_error < 1e-3
