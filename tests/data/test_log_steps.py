"""Each cleaning step against an implementation that shares nothing with it."""

import numpy as np
import pytest
import scipy.ndimage
from scipy.signal import filtfilt

from pinn_dyn.data.logs import (
    Butterworth,
    Deduplicate,
    InputDelay,
    InputRates,
    InterpolateHeld,
    LogError,
    MovingAverage,
    PolynomialFit,
    RemoveJumps,
    Resample,
    RowClock,
    SavitzkyGolayVelocity,
    SplitGaps,
    SubtractStart,
)
from tests.data.logs_files import RATE, recording

RNG = np.random.default_rng(0)
NOISE = RNG.normal(size=(300, 2))


def only(step, item):
    parts, text = step.apply(item)
    assert len(parts) == 1
    return parts[0], text


@pytest.mark.parametrize("window", [1, 4, 5, 50, 1000])
def test_moving_average_is_matlabs_movmean(window):
    back, ahead = window // 2, (window - 1) // 2
    expected = [NOISE[max(k - back, 0) : k + ahead + 1].mean(axis=0) for k in range(len(NOISE))]
    smooth, _ = only(MovingAverage(window=window), recording(NOISE, v=2 * NOISE))
    np.testing.assert_allclose(smooth.q, expected, atol=1e-12)
    np.testing.assert_allclose(smooth.v, 2 * np.array(expected), atol=1e-12)


def test_polynomial_fit_is_that_of_the_normal_equations_and_gives_the_derivative():
    t = 5000.0 + np.arange(101) / RATE  # far from 0, where powers of t itself would fail
    q = np.column_stack([np.sin(4 * t), np.cos(3 * t)])
    parts, text = PolynomialFit(degree=5, segment=0.49).apply(recording(q, t=t))
    assert [len(part) for part in parts] == [50, 50]
    assert "last 1 samples" in text
    for part in parts:
        rows = slice(*np.searchsorted(t, [part.t[0] - 1e-6, part.t[-1] + 1e-6]))
        z = (t[rows] - t[rows].mean()) / np.std(t[rows], ddof=1)
        basis = np.vander(z, 6)
        weights = np.linalg.solve(basis.T @ basis, basis.T @ q[rows])
        np.testing.assert_allclose(part.q, basis @ weights, atol=1e-10)
        # A degree of 5 over half a second is close to the sines themselves.
        slope = np.column_stack([4 * np.cos(4 * part.t), -3 * np.sin(3 * part.t)])
        np.testing.assert_allclose(part.v, slope, atol=2e-2)


def test_butterworth_agrees_with_its_transfer_function_form():
    # b and a of the bilinear transform of 1/(s² + √2 s + 1), written out by hand.
    w = np.tan(np.pi * 10 / RATE)
    a0 = 1 + np.sqrt(2) * w + w**2
    b = np.array([1, 2, 1]) * w**2 / a0
    a = np.array([1, 2 * (w**2 - 1) / a0, (1 - np.sqrt(2) * w + w**2) / a0])
    smooth, _ = only(Butterworth(cutoff=10.0, order=2, signals=["q"]), recording(NOISE))
    expected = filtfilt(b, a, NOISE, axis=0, padlen=10)
    np.testing.assert_allclose(smooth.q, expected, atol=1e-10)


def polynomial_slope(t, x, near, at, order):
    """Slopes at ``t[at]`` of polynomials through the rows ``near`` of each column."""
    return np.polyfit(t[near] - t[at], x[near], order)[-2]


@pytest.mark.parametrize(
    ("order", "causal", "rows"),
    [
        (3, False, {3: 0, 50: 47, 296: 293, 299: 293}),
        (2, True, {6: 0, 50: 44, 299: 293, 2: 0}),
    ],
)
def test_a_savitzky_golay_velocity_is_the_slope_of_local_polynomials(order, causal, rows):
    """Rows, and the first of the seven that count: around a row, or before it if causal."""
    item = recording(NOISE)
    done, _ = only(SavitzkyGolayVelocity(window=7, order=order, causal=causal), item)
    for k, first in rows.items():
        expected = polynomial_slope(item.t, NOISE, slice(first, first + 7), k, order)
        np.testing.assert_allclose(done.v[k], expected, rtol=1e-8)


def test_input_rates_follow_the_inputs():
    item = recording(RNG.normal(size=(300, 1)), u=NOISE)
    done, _ = only(InputRates(window=7, order=3), item)
    rates, _ = only(SavitzkyGolayVelocity(window=7, order=3), recording(NOISE))
    np.testing.assert_array_equal(done.u, np.hstack([NOISE, rates.v]))
    np.testing.assert_array_equal(done.q, item.q)
    labels = ["m1 [rad]", "m2", "d/dt m1 [rad/s]", "d/dt m2"]
    assert InputRates().input_labels(labels[:2]) == labels


def test_resample_draws_straight_lines_on_a_uniform_clock():
    t = np.cumsum(RNG.uniform(0.5, 1.5, size=400)) / RATE
    q = np.column_stack([3 * t + 1, np.sin(t)])
    done, text = only(Resample(rate=200.0, max_gap=0.02), recording(q, t=t))
    np.testing.assert_allclose(np.diff(done.t), 1 / 200, rtol=1e-9)
    np.testing.assert_allclose(done.q[:, 0], 3 * done.t + 1, atol=1e-12)
    assert np.abs(done.q[:, 1] - np.sin(done.t)).max() < 0.015**2 / 8
    assert t[-1] - done.t[-1] < 1 / 200
    assert "400 rows" in text
    gap = np.r_[np.arange(50), 80 + np.arange(50)] / RATE
    with pytest.raises(LogError, match=r"gap of 0.31 s after t = 0.49 s.*SplitGaps"):
        Resample(rate=100.0, max_gap=0.1).apply(recording(NOISE[:100], t=gap))


def test_deduplicate_drops_stale_rows_and_equal_times_and_keeps_a_robot_at_rest():
    """Five repeats of a row are the longest that count as stale, six are a robot at rest."""
    fresh = NOISE[:60]
    stale = np.repeat(fresh, [6 if k == 20 else 7 if k == 40 else 1 for k in range(60)], axis=0)
    done, text = only(Deduplicate(longest=5), recording(stale, u=stale[:, :1]))
    expected = np.repeat(fresh, [7 if k == 40 else 1 for k in range(60)], axis=0)
    np.testing.assert_array_equal(done.q, expected)
    assert "dropped 5 of 71 rows" in text
    done, _ = only(Deduplicate(), recording([1, 2, 9, 3], t=[0.0, 0.01, 0.01, 0.02]))
    np.testing.assert_array_equal(done.q[:, 0], [1, 2, 3])


def test_split_gaps_splits_at_gaps_and_where_the_time_goes_back():
    t = np.r_[np.arange(30), 60 + np.arange(20), 10 + np.arange(40)] / RATE
    parts, text = SplitGaps(longest=0.05).apply(recording(np.arange(90), t=t))
    assert [part.q[0, 0] for part in parts] == [0, 30, 50]
    assert [len(part) for part in parts] == [30, 20, 40]
    assert text.startswith("2 gaps, after 0.29 s, 0.79 s")


def test_remove_jumps_replaces_just_the_jumps_and_reports_them():
    t = np.arange(500) / RATE
    q = np.column_stack([np.sin(2 * t), np.cos(2 * t)])
    spoilt = q.copy()
    spoilt[100:103, 0] += 0.5
    spoilt[300, 1] -= 0.4
    done, text = only(RemoveJumps(threshold=0.1, window=15), recording(spoilt))
    # The bad samples, found with a median filter of another package.
    median = scipy.ndimage.median_filter(spoilt, size=(15, 1))
    bad = np.abs(spoilt - median) > 0.1
    assert bad.sum() == 4
    np.testing.assert_array_equal(done.q[~bad], spoilt[~bad])
    np.testing.assert_allclose(done.q, q, atol=2e-3)
    assert text.startswith("4 of 500 samples replaced")
    done, _ = only(RemoveJumps(threshold=5.0), recording(NOISE))
    np.testing.assert_array_equal(done.q, NOISE)


def test_interpolate_held_joins_updates_and_keeps_a_stand_still():
    slow = np.repeat(np.arange(20.0) ** 2, 5)
    u = np.r_[slow, np.full(50, 400.0), 410.0]
    done, text = only(InterpolateHeld(longest=8), recording(np.arange(151), u=u))
    updates = np.arange(0, 100, 5)
    for k in range(95):
        left = updates[k // 5]
        expected = u[left] + (u[left + 5] - u[left]) * (k - left) / 5
        assert done.u[k, 0] == pytest.approx(expected)
    np.testing.assert_array_equal(done.u[100:150, 0], 400.0)
    assert "53 %" in text


@pytest.mark.parametrize("rate", [50.0, RATE])
def test_a_time_at_rest_and_of_stale_values_is_one_at_every_rate(rate):
    """0.04 s are 2 samples at 50 Hz, and 4 at 100 Hz."""
    count = round(0.04 * rate)
    q = np.arange(30.0) ** 2
    done, _ = only(SubtractStart(samples="0.04 s"), recording(q, rate=rate))
    assert done.q[0, 0] == -np.mean(q[:count])
    u = np.r_[0.0, np.repeat([10.0, 20.0], [count + 1, count + 2]), 30.0]
    held = recording(np.zeros(len(u)), u=u[:, None], rate=rate)
    done, _ = only(InterpolateHeld(longest="40 ms"), held)
    np.testing.assert_allclose(done.u[1 : count + 3, 0], np.linspace(10, 20, count + 2))
    np.testing.assert_array_equal(done.u[count + 2 :, 0], u[count + 2 :])  # one repeat too many


def test_a_delay_shifts_by_fractions_of_a_sample():
    """Rows k with u = (k, 2 k): after 1.55 and 1 samples, u is (k - 1.55, 2 (k - 1))."""
    k = np.arange(10.0)
    steps = InputDelay(delay=[0.0155, 0.01])
    done, text = only(steps, recording(k, u=np.stack([k, 2 * k], 1), rate=100))
    np.testing.assert_array_equal(done.q[:, 0], k[2:])
    np.testing.assert_allclose(done.u, np.stack([k - 1.55, 2 * (k - 1)], 1)[2:])
    assert text == "u delayed by 0.0155 s, 0.01 s"


def test_rates_of_inputs_are_delayed_as_the_inputs():
    rows = np.random.default_rng(0).normal(size=(20, 2))
    (first,), _ = InputRates().apply(recording(NOISE[:20], u=rows))
    done, _ = only(InputDelay(delay=[0.0, 1 / RATE]), first)
    np.testing.assert_allclose(done.u[:, [0, 2]], first.u[1:, [0, 2]])
    np.testing.assert_allclose(done.u[:, [1, 3]], first.u[:-1, [1, 3]])


@pytest.mark.parametrize(
    "step",
    [
        MovingAverage(),
        PolynomialFit(degree=2, segment=0.5),
        Butterworth(cutoff=5.0),
        SavitzkyGolayVelocity(),
        InputRates(),
    ],
)
def test_steps_that_count_samples_refuse_a_jittered_clock(step):
    t = np.cumsum(RNG.uniform(0.5, 1.5, size=300)) / RATE
    with pytest.raises(LogError, match=r"uniform clock.*Resample"):
        step.apply(recording(NOISE, t=t))


@pytest.mark.parametrize(
    ("in_time", "in_samples"),
    [
        (MovingAverage(window="50 ms"), MovingAverage(window=5)),
        (SavitzkyGolayVelocity(window="0.1s"), SavitzkyGolayVelocity(window=9)),  # odd
        (InputRates(window="70ms"), InputRates(window=7)),
        (RemoveJumps(0.1, window="0.25 s"), RemoveJumps(0.1, window=25)),
    ],
    ids=str,
)
def test_windows_in_time_are_those_of_so_many_samples(in_time, in_samples):
    item = recording(NOISE)
    one, other = only(in_time, item)[0], only(in_samples, item)[0]
    for name in "qvu":
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize(
    "step",
    [
        SavitzkyGolayVelocity(window=10),
        RowClock(longest=0.1, rate=50.0),
        MovingAverage(window="5 samples"),
    ],
    ids=str,
)
def test_impossible_settings_are_refused(step):
    with pytest.raises(ValueError, match=r"expected|before it|off a clock"):
        step.apply(recording(NOISE))


def test_a_velocity_is_not_derived_twice():
    with pytest.raises(LogError, match="already has a velocity"):
        SavitzkyGolayVelocity().apply(recording(NOISE, v=NOISE))
