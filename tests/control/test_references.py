"""References: derivatives against finite differences, closed forms, limits and bad input."""

import math

import numpy as np
import pytest
import torch

from pinn_dyn.control.contracts import Motion, Reference
from pinn_dyn.control.references import (
    PointToPoint,
    RandomSetPoints,
    SetPoint,
    Sines,
    check_limits,
)
from pinn_dyn.testing import assert_near, slope

PAIR = [[0.1, -0.4, 1.0], [0.5, 0.2, -1.0]]

REFERENCES = {
    "set_point": SetPoint(PAIR),
    "point_to_point": PointToPoint([0.1, -0.4, 1.0], [1.0, -0.5, 0.0], duration=2.0, begin=0.3),
    "pairs": PointToPoint(PAIR, [[1.0, 1.0, 1.0], [0.0, 0.0, 0.0]], duration=1.5),
    "one_start_two_ends": PointToPoint([0.0, 0.0, 0.0], PAIR, duration=1.5),
    "sines": Sines([0.1, 0.2, 0.3], 0.7, [0.5, 1.0, 0.0], phase=[0.0, 0.4, 1.0]),
    "risen_sines": Sines(PAIR, [0.7, 0.1, 1.2], 0.8, phase=0.3, rise_time=1.2),
}


@pytest.mark.parametrize("name", REFERENCES)
def test_derivatives_match_finite_differences(name):
    reference = REFERENCES[name]
    assert isinstance(reference, Reference)
    assert reference.num_coordinates == 3
    # No stencil reaches over a joint of two pieces, where the third derivative jumps.
    for t in (0.05, 0.41, 0.77, 1.1, 1.45, 1.97, 2.6):
        q, v, a = reference(t)
        assert q.shape == v.shape == a.shape
        assert q.dtype == v.dtype == a.dtype == torch.float64
        assert_near(v, slope(lambda e, t=t: reference(t + e).q), 1e-9, scale=10)
        assert_near(a, slope(lambda e, t=t: reference(t + e).v), 1e-9, scale=10)


def test_random_set_points_fill_their_box_and_follow_the_seed():
    low, high = [-1.0, 2.0], [1.0, 2.5]
    q = RandomSetPoints(low, high, count=2000, seed=5)(0.0).q.numpy()
    assert q.shape == (2000, 2)
    # Mean and standard deviation of a uniform distribution, within four standard errors.
    width = np.subtract(high, low)
    np.testing.assert_allclose(q.mean(0), np.mean([low, high], 0), atol=(0.026 * width).max())
    np.testing.assert_allclose(q.std(0) / width, 1 / math.sqrt(12), atol=0.012)
    assert abs(np.corrcoef(q.T)[0, 1]) < 0.09
    assert (q >= low).all()
    assert (q <= high).all()
    again = RandomSetPoints(low, high, count=2000, seed=5)(0.0).q.numpy()
    np.testing.assert_array_equal(again, q)
    assert not np.allclose(RandomSetPoints(low, high, count=2000, seed=6)(0.0).q, q)


def test_point_to_point_rests_moves_and_rests():
    start, end = np.array([0.1, -0.4, 1.0]), np.array([1.0, -0.5, 0.0])
    reference = PointToPoint(start.tolist(), end.tolist(), duration=2.0, begin=0.3)
    for t, q in ((0.0, start), (0.3, start), (1.3, 0.5 * (start + end)), (2.3, end), (9.0, end)):
        np.testing.assert_allclose(reference(t).q, q, atol=1e-15)
        if t != 1.3:
            assert reference(t).v.abs().max() < 1e-14
            assert reference(t).a.abs().max() < 1e-14
    times = np.linspace(0, 3, 3001)
    speed = max(float(reference(t).v[0]) for t in times)
    acceleration = max(float(reference(t).a[0]) for t in times)
    assert speed == pytest.approx(15 / 8 * 0.9 / 2, rel=1e-9)
    assert acceleration == pytest.approx(10 / math.sqrt(3) * 0.9 / 4, rel=1e-6)


def test_sines_start_from_rest_and_become_the_closed_form():
    reference = REFERENCES["risen_sines"]
    q, v, a = reference(0.0)
    np.testing.assert_array_equal(q, PAIR)
    assert not v.any()
    assert not a.any()
    t = 1.7
    wave = np.array([0.7, 0.1, 1.2]) * math.sin(2 * math.pi * 0.8 * t + 0.3)
    np.testing.assert_allclose(reference(t).q, PAIR + wave, rtol=0, atol=1e-14)
    half = reference(0.6).q - torch.tensor(PAIR, dtype=torch.float64)
    wave = np.array([0.7, 0.1, 1.2]) * math.sin(2 * math.pi * 0.8 * 0.6 + 0.3)
    np.testing.assert_allclose(half, np.broadcast_to(0.5 * wave, (2, 3)), rtol=0, atol=1e-14)


# Limits.


def test_limits_name_first_time_joint_and_value():
    reference = Sines([0.0, 0.0], [0.4, 1.0], 0.25)
    check_limits(reference, [-0.4, -1.0], [0.4, 1.0], duration=4.0, v_max=[0.63, 1.58])
    check_limits(reference, [-np.inf, -1.0], [np.inf, 1.0], duration=4.0, v_max=np.zeros(2))
    # sin(2 pi t / 4) = 0.5 at t = 1/3.
    with pytest.raises(ValueError, match=r"t = 0\.334 s: q\[1\] is 0\.5\d*, expected -1 to 0\.5"):
        check_limits(reference, [-0.4, -1.0], [0.4, 0.5], duration=4.0)
    with pytest.raises(ValueError, match=r"t = 0 s: v\[1\] is 1\.571, expected -1\.5"):
        check_limits(reference, [-1, -1], [1, 1], duration=4.0, v_max=[1.0, 1.5])
    # cos = -1/1.571 first at t = (pi/2 + asin(1/1.571)) 2 / pi: downwards.
    slow = Sines([0.0, 0.0], [0.4, 1.0], 0.25, phase=math.pi / 2)
    with pytest.raises(ValueError, match=r"t = 0\.44 s: v\[1\] is -1\.00\d*"):
        check_limits(slow, [-1, -1], [1, 1], duration=4.0, v_max=[1.0, 1.0])


def test_limits_name_the_configuration_among_many_and_refuse_a_nan():
    with pytest.raises(ValueError, match=r"t = 0 s: q\[2\] of run 1 is -1,"):
        check_limits(SetPoint(PAIR), [-0.5] * 3, [1.0] * 3, duration=1.0)

    class Broken(Reference):
        num_coordinates = 1

        def __call__(self, t):
            return Motion(*(torch.tensor([math.nan]) for _ in range(3)))

    with pytest.raises(ValueError, match=r"q\[0\] is nan"):
        check_limits(Broken(), [-1.0], [1.0], duration=1.0)
