"""Delays between input and motion: measured where the data tell, refused where they do not."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pinn_dyn.data.logs import LogSource, Recording
from pinn_dyn.log_check.delay import DelayCurve, clear_delays, input_delays
from tests.support.delayed_robots import log, motor_arm, seven_regressor, sines


@pytest.mark.parametrize("kind", ["pendulum", "arm", "tendons"])
@pytest.mark.parametrize(("seed", "delay"), [(0, 0.0), (1, 0.043)])
def test_a_known_delay_is_measured_within_a_sample(kind, seed, delay):
    for curve in input_delays([log(kind, seed, delay)]):
        assert curve.delay == pytest.approx(delay, abs=0.01)


@pytest.mark.parametrize(("seed", "delay"), [(0, 0.0), (1, 0.043)])
def test_seven_joints_whose_kinematics_are_known(seed, delay):
    curves = input_delays([log("seven joints", seed, delay)], rigid=seven_regressor)
    for curve in curves:
        assert curve.delay == pytest.approx(delay, abs=0.01)
    assert sum(curve.form == "rigid bodies" for curve in curves) >= 5


def test_seven_joints_alone_get_no_wrong_answer():
    """30 s are too few for seven joints: a smooth remainder has its minimum anywhere."""
    for seed in (100, 101):
        for curve in input_delays([log("seven joints", seed, 0.05, seconds=30.0)]):
            assert curve.delay is None or curve.delay == pytest.approx(0.05, abs=0.01)


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 99))
def test_the_inertia_of_an_arm_that_motors_pull_is_no_delay(seed):
    curves = input_delays([motor_arm(seed, 0.0)], motors=True)
    assert not any(clear_delays(curves, 0.01))


@pytest.mark.parametrize("seed", [2, 5, 9])
def test_motors_that_act_late_get_one_delay(seed):
    """The lag of the inertia is a part of the answer: it may be half too long."""
    delays = clear_delays(input_delays([motor_arm(seed, 0.07)], motors=True), 0.01)
    assert delays == pytest.approx([0.07] * len(delays), abs=0.035)


@pytest.mark.parametrize("kind", ["pendulum", "arm", "tendons"])
def test_a_slow_sine_gets_no_answer(kind):
    for curve in input_delays([log(kind, 0, 0.04, highest=0.1, number=1)]):
        assert curve.delay is None
        assert curve.reason


def test_inputs_may_have_different_delays():
    item = log("arm", 3, 0.1)
    shifted = np.column_stack([item.u[:-6, 0], item.u[6:, 1]])
    first, second = input_delays([replace(item, t=item.t[:-6], q=item.q[:-6], u=shifted)])
    assert first.delay == pytest.approx(0.1, abs=0.01)
    assert second.delay == pytest.approx(0.16, abs=0.01)


def test_noise_for_an_input_gets_no_answer():
    item = log("arm", 4, 0.05)
    noise = np.random.default_rng(0).normal(size=item.u.shape)
    assert all(curve.delay is None for curve in input_delays([replace(item, u=noise)]))


def test_the_lag_of_a_pneumatic_joint_is_no_delay():
    """Two pressures in bar follow their commands in 60 ms; the joint has inertia and damping."""
    t, parts, steps = np.arange(1500) / 100, [], 5
    for seed in range(4):
        rng = np.random.default_rng(seed)
        command = 2.5 + sines(rng, 2, size=0.8, highest=1.2)(t)
        (a, b), q, v, path = command[0], 0.0, 0.0, []
        for first, second in command:
            path.append(q)
            for _ in range(steps):
                a, b = a + (first - a) / 30, b + (second - b) / 30
                torque = 2 * (a * (1 - 0.4 * q) - b * (1 + 0.4 * q)) - 4 * q - 1.2 * np.sin(q)
                v += 0.002 * (torque - 0.5 * v - 0.15 * np.tanh(20 * v)) / 0.04
                q += 0.002 * v
        motion = np.array(path)[:, None] + 1e-3 * np.std(path) * rng.normal(size=(len(t), 1))
        parts.append(Recording(f"run{seed}", t, motion, None, command))
    for curve in input_delays(parts):
        assert curve.delay is None or curve.delay < 0.1


def test_friction_that_rises_near_rest_is_no_delay():
    rng = np.random.default_rng(1)
    rates, phases = 2 * np.pi * rng.uniform(0.08, 0.7, 4), rng.uniform(0, 2 * np.pi, 4)
    sizes, t = rng.uniform(0.1, 0.45, 4), np.arange(60_000) / 1000
    phase = np.outer(t, rates) + phases
    reference, slopes = np.sin(phase) @ sizes, np.cos(phase) @ (sizes * rates)
    q, v, motion, torque = reference[0], 0.0, [], []
    for goal, slope in zip(reference, slopes, strict=True):
        u = 12 * (goal - q) + slope - v
        motion.append(q)
        torque.append(u)
        level = 0.4 * (1 + 0.6 * np.exp(-((v / 0.08) ** 2)))
        free = v + 0.05 * (u - 0.15 * v - 0.3 * np.sin(q))
        v = np.sign(free) * max(abs(free) - 0.05 * level, 0.0)
        q += 0.001 * v
    measured = np.array(motion)[::4, None] + 1e-4 * rng.normal(size=(15_000, 1))
    inputs = np.array(torque)[::4, None] + 0.05 * rng.normal(size=(15_000, 1))
    curves = input_delays([Recording("run", t[::4], measured, None, inputs)])
    assert curves[0].dry
    assert clear_delays(curves, 0.004) == [0.0]


@pytest.mark.parametrize(
    ("delay", "spread", "clear"),
    [(1.5, 0.2, True), (1.5, 0.5, False), (0.9, 0.01, False), (1.1, 0.01, True)],
)
def test_the_hold_of_a_sample_is_no_delay(delay, spread, clear):
    """A delay counts from one sample on, if its interval excludes the half sample of a hold."""
    step = 0.01
    d = step * np.arange(-2, 9)
    curve = DelayCurve(d, np.ones(len(d)), delay * step, spread * step, "inverse dynamics")
    assert clear_delays([curve], step) == pytest.approx([delay * step * clear])


@pytest.mark.parametrize("delay", [0.013, 0.2])
def test_runs_as_long_as_a_piece_load_with_a_delay(delay):
    """The pieces lose the samples that the shift of the inputs drops, and no more."""
    t = np.arange(401) / 100
    runs = {
        f"r{k}": pd.DataFrame({"t": t, "q": np.sin(t * (1 + k)), "u": np.cos(t * (2 + k))})
        for k in range(4)
    }
    part = {"runs": 1, "piece": 4.0}

    def loaded(lag):
        source = LogSource(
            files=runs,
            time="t",
            q={"columns": ["q"], "unit": "rad"},
            u={"columns": ["u"], "unit": "Nm"},
            validation=part,
            test=part,
            delay=lag,
        )
        splits = source.load()
        return [x.duration for x in (*splits.validation, *splits.test)], source.report

    lengths, report = loaded(delay)
    assert lengths == pytest.approx([int((4.0 - delay) * 100 + 1e-6) / 100] * 2)
    assert "as the input delay drops" in report
    assert loaded(0.0)[0] == pytest.approx([4.0, 4.0])
