"""Excitation signals: bounds, order, smoothness, frequencies, seeds and bad arguments."""

import numpy as np
import pytest

from pinn_dyn.data import Chirp, Mixture, MultiSine, Steps
from pinn_dyn.data.excitation import picked_signals

OFFSET = np.array([0.5, -2.0])
AMPLITUDE = np.array([1.0, 0.25])
DURATION = 6.0
TIME = np.linspace(0, DURATION, 3001)

KINDS = {
    "sine": MultiSine(OFFSET, AMPLITUDE, frequency=[0.5, 3.0], harmonics=1),
    "multi-sine": MultiSine(OFFSET, AMPLITUDE, frequency=[0.5, 3.0], harmonics=5),
    "chirp": Chirp(OFFSET, AMPLITUDE, frequency=[0.5, 3.0]),
    "steps": Steps(OFFSET, AMPLITUDE, hold=[0.3, 1.0], rise_time=0.1),
}
KINDS["mixture"] = Mixture(list(KINDS.values()))


def samples(excitation, count=30, seed=0, t=TIME):
    return excitation.draw(count, DURATION, np.random.default_rng(seed))(t)


@pytest.mark.parametrize("kind", KINDS)
def test_signals_move_within_their_amplitude_about_the_offset(kind):
    u = samples(KINDS[kind])
    assert u.shape == (30, TIME.size, 2)
    excursion = np.abs(u - OFFSET).max(axis=(0, 1))
    assert (excursion <= AMPLITUDE * (1 + 1e-12)).all()
    # Not by standing still: the largest of 30 peaks comes near the bound.
    assert (excursion > 0.6 * AMPLITUDE).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_gives_the_same_signals_again_and_another_seed_gives_others(kind):
    first, again, other = (samples(KINDS[kind], seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (np.abs(first - other).max(axis=(1, 2)) > 1e-3).all()
    # Signals that are drawn together differ, too.
    assert len(np.unique(first.reshape(len(first), -1), axis=0)) == len(first)


@pytest.mark.parametrize("kind", KINDS)
def test_a_signal_is_a_function_of_time_alone(kind):
    """The solver asks for single times in any order, the data set for all at once."""
    signal = KINDS[kind].draw(7, DURATION, np.random.default_rng(4))
    together = signal(TIME[:50])
    one_by_one = np.concatenate([signal(TIME[k : k + 1]) for k in reversed(range(50))], axis=1)
    np.testing.assert_allclose(one_by_one[:, ::-1], together, rtol=0, atol=1e-12)


def test_signals_of_several_draws_are_joined():
    draws = [KINDS["steps"].draw(4, DURATION, np.random.default_rng(k)) for k in range(2)]
    signal = picked_signals(draws, np.array([0, 1, 0]), np.array([3, 0, 3]))
    expected = np.stack([draws[0](TIME)[3], draws[1](TIME)[0], draws[0](TIME)[3]])
    np.testing.assert_array_equal(signal(TIME), expected)


@pytest.mark.parametrize("count", [2, 5])
def test_a_mixture_takes_its_parts_in_turn(count):
    """Parts with offsets far apart show which part a signal came from."""
    parts = [MultiSine([10.0 * k], [1.0]) for k in range(3)]
    u = samples(Mixture(parts), count=count)
    assert u.shape[0] == count
    np.testing.assert_array_equal(np.round(u.mean(axis=(1, 2)) / 10), np.arange(count) % 3)


def test_steps_are_smooth_ramps_between_held_levels():
    """A minimum-jerk ramp over r has slopes up to 15/8 jump/r and curvatures up to 5.78 jump/r^2.

    A jump is at most twice the amplitude.
    """
    rise = 0.1
    excitation = Steps(OFFSET, AMPLITUDE, hold=[0.3, 1.0], rise_time=rise)
    u = samples(excitation, count=40) - OFFSET
    h = TIME[1] - TIME[0]
    slope = np.abs(np.diff(u, axis=1)).max(axis=(0, 1)) / h
    curvature = np.abs(np.diff(u, n=2, axis=1)).max(axis=(0, 1)) / h**2
    assert (slope <= 15 / 8 * 2 * AMPLITUDE / rise).all()
    assert (curvature <= 5.78 * 2 * AMPLITUDE / rise**2).all()
    # It does step, and holds between: ramps fill at most a third of the time.
    assert (slope > 0.5 * AMPLITUDE / rise).all()
    held = (np.abs(np.diff(u, axis=1)) < 1e-12).mean()
    assert 0.6 < held < 0.95


def test_a_chirp_sweeps_from_one_end_of_its_band_to_the_other():
    """The phase is quadratic in time, so its zero crossings tell the frequency at both ends."""
    low, high, duration = 1.0, 4.0, 10.0
    t = np.linspace(0, duration, 40001)
    chirp = Chirp([0.0], [1.0], frequency=[low, high])
    u = chirp.draw(12, duration, np.random.default_rng(0))(t)[..., 0]
    downward = 0
    for signal in u:
        k = np.flatnonzero(np.diff(np.sign(signal)) != 0)
        crossing = t[k] - signal[k] * (t[k + 1] - t[k]) / (signal[k + 1] - signal[k])
        half_turns = np.polynomial.Polynomial.fit(crossing, np.arange(len(k)), 2)
        ends = half_turns.deriv()(np.array([0.0, duration])) / 2
        np.testing.assert_allclose(np.sort(ends), [low, high], rtol=1e-3)
        downward += ends[0] > ends[1]
    assert 0 < downward < 12


def test_frequencies_of_a_sine_lie_in_its_band():
    t = np.linspace(0, 20, 20001)
    u = MultiSine([0.0], [1.0], frequency=[1.0, 2.0], harmonics=1)
    u = u.draw(20, 20.0, np.random.default_rng(0))(t)[..., 0]
    turns = (np.diff(np.sign(u), axis=1) != 0).sum(axis=1) / 2
    assert (turns >= 1.0 * 20 - 0.5).all()
    assert (turns <= 2.0 * 20 + 0.5).all()
    assert np.ptp(turns) > 5
