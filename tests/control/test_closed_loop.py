"""Closed loops, against matrix exponentials, and what happens when something goes wrong."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from pinn_dyn.control.continuous_loop import close_loop_continuous
from pinn_dyn.control.effects import Actuator, Sensor
from tests.support.closed_loops import K_D, K_P, PD, Q0, V0, Wave, double, sampled, spring


def feedback(x, t, amplitude):
    q, v = np.split(x, 2)
    return K_P * (amplitude * np.sin(2 * t) - q) + K_D * (2 * amplitude * np.cos(2 * t) - v)


# Against independent answers.


@pytest.mark.parametrize("delay", [0, 3])
@pytest.mark.parametrize("amplitude", [[0.5, -1.0], [[0.5, -1.0], [0.0, 0.0], [1.0, 2.0]]])
def test_sampled_loop_is_the_exact_discrete_one(delay, amplitude):
    record = sampled(reference=Wave(double(amplitude)), delay=delay)
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
    torch.testing.assert_close(record.diagnostics["time"], record.t.expand(3, -1))


def test_continuous_loop_is_a_matrix_exponential():
    amplitude = np.array([0.5, -1.0])
    record = close_loop_continuous(
        spring(), PD(), Wave(double(amplitude.tolist())), Q0, V0, duration=2.0, samples_rate=10.0
    )
    f, b = spring().state_space()
    closed = f - b @ np.hstack([K_P * np.eye(2), K_D * np.eye(2)])
    # sin(2 t) and cos(2 t) are states of their own.
    forcing = b @ np.stack([K_P * amplitude, 2 * K_D * amplitude], 1)
    waves = np.array([[0.0, 2.0], [-2.0, 0.0]])
    matrix = np.block([[closed, forcing], [np.zeros((2, 4)), waves]])
    for copy in range(3):
        start = np.concatenate([Q0[copy], V0[copy], [0.0, 1.0]])
        expected = np.stack([expm(matrix * t) @ start for t in record.t.tolist()])
        np.testing.assert_allclose(record.q[copy], expected[:, :2], rtol=0, atol=2e-5)
        np.testing.assert_allclose(record.v[copy], expected[:, 2:4], rtol=0, atol=1e-4)
        u = [
            feedback(x[:4], t, amplitude) for x, t in zip(expected, record.t.tolist(), strict=True)
        ]
        np.testing.assert_allclose(record.u[copy], u, rtol=0, atol=1e-3)
    torch.testing.assert_close(record.u, record.u_wanted)


def test_continuous_loop_limits_the_input_all_the_time():
    record = close_loop_continuous(
        spring(),
        PD(),
        Wave(double([0.5, -1.0])),
        Q0[:1],
        V0[:1],
        duration=1.0,
        samples_rate=10.0,
        actuator=Actuator(low=-2.0, high=[3.0, 1.0]),
    )
    f, b = spring().state_space()

    def derivative(t, x):
        u = feedback(x, t, np.array([0.5, -1.0]))
        return f @ x + b @ np.clip(u, -2, [3, 1])

    start = np.concatenate([Q0[0], V0[0]])
    expected = solve_ivp(
        derivative, (0, 1), start, t_eval=record.t, rtol=1e-8, atol=1e-9, max_step=1e-3
    ).y.T
    np.testing.assert_allclose(record.q[0], expected[:, :2], rtol=0, atol=1e-4)
    torch.testing.assert_close(
        record.u[0], record.u_wanted[0].clamp(double([-2.0, -2.0]), double([3.0, 1.0]))
    )
    count = (record.u != record.u_wanted).sum(-1).double()
    assert count.max() > 0
    torch.testing.assert_close(record.diagnostics["saturated_inputs"], count)


def test_a_stiff_continuous_loop_is_solved_in_few_evaluations():
    calls = []

    class Counted(PD):
        def __call__(self, t, q, v, reference):
            calls.append(t)
            return super().__call__(t, q, v, reference)

    still = Wave(double([0.0, 0.0]))
    law = Counted(k_p=1e4, k_d=1e6)
    record = close_loop_continuous(spring(), law, still, Q0, V0, duration=1.0, samples_rate=5.0)
    assert len(calls) < 1000
    # What is left of the motion is q' = -K_P / K_D q, the springs are weak beside the gains.
    expected = Q0[:, None] * torch.exp(-0.01 * record.t)[:, None]
    torch.testing.assert_close(record.q, expected, rtol=0, atol=1e-4)


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
