"""Delays between input and motion: found where the data tell, refused where they do not."""

from dataclasses import replace

import numpy as np
import pytest

from pinn_dyn.data.logs import InputDelay, agreed_delays, input_delays
from pinn_dyn.data.logs import delay as delay_module
from tests.support.delayed_robots import log, seven_regressor


@pytest.mark.parametrize("kind", ["pendulum", "arm", "tendons"])
@pytest.mark.parametrize(("seed", "delay"), [(0, 0.0), (1, 0.043), (2, 0.1)])
def test_a_known_delay_is_found_within_a_sample(kind, seed, delay):
    for curve in input_delays([log(kind, seed, delay)]):
        assert curve.delay == pytest.approx(delay, abs=0.01)


@pytest.mark.parametrize(("seed", "delay"), [(0, 0.0), (1, 0.043), (2, 0.1)])
def test_seven_joints_whose_kinematics_are_known(seed, delay):
    curves = input_delays([log("seven joints", seed, delay)], rigid=seven_regressor)
    for curve in curves:
        assert curve.delay == pytest.approx(delay, abs=0.01)
    assert sum(curve.form == "rigid bodies" for curve in curves) >= 5


@pytest.mark.parametrize("seconds", [12.0, 30.0])
def test_seven_joints_alone_get_no_wrong_answer(seconds):
    """30 s are too few for the terms of seven joints: a smooth rest has its minimum anywhere."""
    for seed in (100, 101, 102):
        for curve in input_delays([log("seven joints", seed, 0.05, seconds=seconds)]):
            assert curve.delay is None or curve.delay == pytest.approx(0.05, abs=0.01)


@pytest.mark.parametrize("kind", ["pendulum", "arm", "tendons"])
def test_a_slow_sine_gets_no_answer(kind):
    for curve in input_delays([log(kind, 0, 0.04, highest=0.1, number=1)]):
        assert curve.delay is None
        assert curve.reason


def test_inputs_may_have_delays_of_their_own():
    item = log("arm", 3, 0.1)
    shifted = np.column_stack([item.u[:-6, 0], item.u[6:, 1]])
    first, second = input_delays([replace(item, t=item.t[:-6], q=item.q[:-6], u=shifted)])
    assert first.delay == pytest.approx(0.1, abs=0.01)
    assert second.delay == pytest.approx(0.16, abs=0.01)
    shared = input_delays([log("arm", 3, 0.05)], common=True)
    assert shared[0] is shared[1] or shared[0].delay == shared[1].delay
    assert shared[0].delay == pytest.approx(0.05, abs=0.01)


def test_noise_for_an_input_gets_no_answer():
    item = log("arm", 4, 0.05)
    noise = np.random.default_rng(0).normal(size=item.u.shape)
    assert all(curve.delay is None for curve in input_delays([replace(item, u=noise)]))


def test_given_delays_shift_each_input():
    item = log("arm", 0, 0.0)
    (shifted,), _ = InputDelay(delay=[0.02, 0.05]).apply(item)
    np.testing.assert_array_equal(shifted.u[:, 0], item.u[3:-2, 0])
    np.testing.assert_array_equal(shifted.u[:, 1], item.u[:-5, 1])


def both(first, second):
    """The arm with the torque of each joint late by its own time."""
    slow, slower = log("arm", 3, first), log("arm", 3, second)
    return replace(slow, u=np.column_stack([slow.u[:, 0], slower.u[:, 1]]))


def test_inputs_with_different_delays_keep_them():
    curves = agreed_delays([both(0.02, 0.06)])
    assert [curve.delay for curve in curves] == pytest.approx([0.02, 0.06], abs=0.005)


def test_an_input_without_an_answer_takes_that_of_all(monkeypatch):
    item = log("arm", 3, 0.03)
    single = input_delays([item])
    lost = [single[0], replace(single[1], delay=None, reason="the residual is all but the same")]
    answers = {False: lost, True: input_delays([item], common=True)}
    monkeypatch.setattr(
        delay_module, "input_delays", lambda *_, common=False, **__: answers[common]
    )
    curves = agreed_delays([item])
    assert [curve.form for curve in curves] == ["inverse dynamics, common"] * 2
    assert [curve.delay for curve in curves] == pytest.approx([0.03, 0.03], abs=0.005)
    lost[1] = replace(lost[1], reason=delay_module._AFTER)
    assert agreed_delays([item]) == lost
