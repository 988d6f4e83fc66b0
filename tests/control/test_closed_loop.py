"""Closed loops, against matrix exponentials, and what happens when something goes wrong."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from pinn_dyn.control import Pipeline
from pinn_dyn.control.effects import Actuator, Sensor
from tests.support.closed_loops import K_D, K_P, PD, Q0, V0, Wave, double, sampled, spring


def feedback(x, t, amplitude):
    q, v = np.split(x, 2)
    return K_P * (amplitude * np.sin(2 * t) - q) + K_D * (2 * amplitude * np.cos(2 * t) - v)


# Against independent answers.


@pytest.mark.parametrize("delay", [0, 3])
@pytest.mark.parametrize("amplitude", [[0.5, -1.0], [[0.5, -1.0], [0.0, 0.0], [1.0, 2.0]]])
def test_sampled_loop_is_the_exact_discrete_one(delay, amplitude):
    record = sampled(reference=Wave(double(amplitude)), dead_time=delay / 50)
    f, b = spring().state_space()
    step = expm(np.block([[f, b], [np.zeros((2, 6))]]) * 0.02)
    amplitudes = np.broadcast_to(np.array(amplitude), (3, 2))
    assert record.t.shape == (21,)
    for copy in range(3):
        x, on_their_way = np.concatenate([Q0[copy], V0[copy]]), [np.zeros(2)] * delay
        for k in range(21):
            wanted = feedback(x, k / 50, amplitudes[copy])
            on_their_way.append(wanted)
            u = on_their_way.pop(0)
            for name, expected in (("q", x[:2]), ("v", x[2:]), ("u", u), ("u_wanted", wanted)):
                found = getattr(record, name)[copy, k]
                np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6, err_msg=name)
            x = (step @ np.concatenate([x, u]))[:4]
        np.testing.assert_allclose(
            record.reference.a[copy], -4 * amplitudes[copy] * np.sin(2 * record.t.numpy())[:, None]
        )
    assert record.stopped == [None] * 3
    torch.testing.assert_close(record.diagnostics["distance"], record.q.norm(dim=-1))


def test_the_law_sees_the_noise_and_the_record_the_truth():
    record = sampled(sensor=Sensor(q_noise=0.05, v_noise=[0.1, 0.2], seed=4))
    sensor = Sensor(q_noise=0.05, v_noise=[0.1, 0.2], seed=4)
    for k in range(21):
        q, v = sensor(record.q[:, k], record.v[:, k])
        reference = record.reference
        expected = K_P * (reference.q[:, k] - q) + K_D * (reference.v[:, k] - v)
        torch.testing.assert_close(record.u_wanted[:, k], expected)


def test_the_plant_gets_the_limited_input():
    record = sampled(actuator=Actuator(low=-1.0, high=2.0, rate=50.0))
    u = record.u
    assert (u.min(), u.max()) == (-1.0, 2.0)
    assert u[:, 0].abs().max() <= 1.0  # 50 per s for one instant, from zero
    assert u.diff(dim=1).abs().max() <= 1.0 + 1e-12
    count = (u != record.u_wanted).sum(-1).double()
    torch.testing.assert_close(record.diagnostics["saturated_inputs"], count)
    f, b = spring().state_space()
    step = expm(np.block([[f, b], [np.zeros((2, 6))]]) * 0.02)
    x = torch.cat([record.q, record.v, u], -1)
    expected = x[:, :-1] @ torch.from_numpy(step.T)
    torch.testing.assert_close(x[:, 1:, :4], expected[..., :4], rtol=0, atol=1e-6)


def test_the_period_and_the_limits_of_a_pipeline_are_those_of_the_loop():
    pipeline = Pipeline(PD(), 0.02, actuator=Actuator(low=-1.0, high=2.0, rate=50.0))
    expected = sampled(actuator=Actuator(low=-1.0, high=2.0, rate=50.0))
    torch.testing.assert_close(sampled(controller=pipeline).u, expected.u, rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match=r"period of the pipeline is 0.01 s, expected 0.02 s"):
        sampled(controller=Pipeline(PD(), 0.01))
    with pytest.raises(ValueError, match="actuator: the controller is a pipeline"):
        sampled(controller=pipeline, actuator=Actuator(low=0.0))


def test_the_input_before_the_first_call_acts_during_the_dead_time():
    pipeline = Pipeline(PD(), 0.02, first_input=[0.5, -2.0])
    record = sampled(controller=pipeline, dead_time=0.04)
    assert record.u[:, :2].tolist() == [[[0.5, -2.0]] * 2] * 3
    assert (record.u[:, 2] == record.u_wanted[:, 0]).all()
