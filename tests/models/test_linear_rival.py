"""Linear rivals recover linear and quadratic systems that are known exactly."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models.linear_rival import LinearRival, fit_linear_rival

STEP = 0.05


def oscillators(count, *, interpolation="hold", samples=121, seed=0, stride=1):
    """Two coupled damped oscillators under random inputs, by matrix exponentials."""
    stiffness, damping = np.array([[40.0, -9.0], [-9.0, 25.0]]), np.diag([0.8, 0.5])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-stiffness, -damping]])
    B = np.vstack([np.zeros((2, 1)), [[1.0], [3.0]]])
    h = STEP / stride
    # Exact under a held input, and under one on a straight line (van Loan 1978).
    block = np.zeros((6, 6))
    block[:4, :4], block[:4, 4:5], block[4, 5] = A, B, 1.0
    F = expm(h * block)
    rng = np.random.default_rng(seed)
    t = torch.arange(samples, dtype=torch.float64) * h
    found = []
    for _ in range(count):
        u = rng.normal(size=(samples, 1))
        x = np.zeros((samples, 4))
        x[0] = rng.normal(size=4) * [0.3, 0.3, 1.0, 1.0]
        for k in range(samples - 1):
            slope = 0 * u[k] if interpolation == "hold" else (u[k + 1] - u[k]) / h
            x[k + 1] = (F @ np.concatenate([x[k], u[k], slope]))[:4]
        q, v = torch.from_numpy(x).split(2, dim=-1)
        found.append(Trajectory(q, v, Signal(t, torch.from_numpy(u), interpolation)))
    return found


def predicted(rival, truth, step=STEP):
    stride = round(step / float(truth.t[1]))
    x = rival.predict(truth.states("qv")[0], truth.t[::stride], truth.input)
    return x[:, :2], truth.q[::stride]


@pytest.mark.parametrize("interpolation", ["hold", "linear"])
def test_arx_of_one_lag_recovers_a_linear_system(interpolation):
    train = oscillators(4, interpolation=interpolation)
    (test,) = oscillators(1, interpolation=interpolation, seed=9)
    rival = LinearRival(train, step=STEP, lags=1, degree=1, ridge=1e-12)
    q_hat, q = predicted(rival, test)
    assert q.abs().max() > 0.5
    torch.testing.assert_close(q_hat, q, rtol=0, atol=1e-8)


def delayed(count, seed):
    """q_{k+1} - q_k = 0.3 u_{k-2}: only who looks three samples back can know it."""
    rng = np.random.default_rng(seed)
    t = STEP * torch.arange(200, dtype=torch.float64)
    found = []
    for _ in range(count):
        u = torch.from_numpy(rng.normal(size=(200, 1)))
        q = torch.zeros(200, 1, dtype=torch.float64)
        q[3:] = 0.3 * u[:-3].cumsum(0)
        found.append(Trajectory(q, torch.zeros_like(q), Signal(t, u, "hold")))
    return found


def test_a_delayed_input_needs_lags_and_gets_them():
    rival = fit_linear_rival(delayed(3, 0), delayed(2, 1), step=STEP, degree=1)
    assert rival.lags >= 4
    (test,) = delayed(1, 2)
    x = rival.predict(test.states("qv")[0], test.t, Signal(test.t, test.u, "hold"))
    # What acted before the start is unknown: an offset, after which all increments are right,
    # within what the ridge takes away.
    torch.testing.assert_close(x[5:, :1].diff(dim=0), test.q[5:].diff(dim=0), rtol=0, atol=2e-3)


def quadratic(count, seed):
    """q_{k+1} = q_k + h v_k, v_{k+1} = 0.9 v_k - 0.4 q_k - 0.5 q_k^2 + u_k / 4."""
    rng = np.random.default_rng(seed)
    t = STEP * torch.arange(100, dtype=torch.float64)
    found = []
    for _ in range(count):
        u = torch.from_numpy(0.3 * rng.normal(size=(100, 1)))
        q, v = (torch.zeros(100, 1, dtype=torch.float64) for _ in range(2))
        q[0] = float(rng.uniform(-0.3, 0.3))
        for k in range(99):
            q[k + 1] = q[k] + STEP * v[k]
            v[k + 1] = 0.9 * v[k] - 0.4 * q[k] - 0.5 * q[k] ** 2 + u[k] / 4
        found.append(Trajectory(q, v, Signal(t, u, "hold")))
    return found


def test_the_past_of_a_step_is_that_of_the_steps_before():
    train = oscillators(3, interpolation="linear")
    rival = LinearRival(train, step=STEP, lags=3, degree=1, ridge=1e-7)
    generator = torch.Generator().manual_seed(0)
    rival.weight.copy_(0.1 * torch.randn(rival.weight.shape, generator=generator))
    (truth,) = oscillators(1, samples=9, interpolation="linear")
    known = torch.cat([truth.states("qv")[0], truth.u[0]])
    past = known @ rival.past_weight + rival.past_bias
    x = [*past[:8].split(4)[::-1], truth.states("qv")[0]]  # x_-2, x_-1, x_0
    u = [*past[8:].split(1)[::-1], *truth.u]
    for k in range(8):
        now = k + 2
        state = torch.cat([x[now], x[now - 1], x[now - 2], u[now - 1], u[now - 2]])
        features = torch.cat([(state - rival.mean) / rival.scale, u[now], u[now + 1]])
        x.append(x[now] + features @ rival.weight + rival.bias)
    found = rival.predict(truth.states("qv")[0], truth.t, truth.input)
    torch.testing.assert_close(found, torch.stack(x[2:]), rtol=1e-9, atol=1e-9)


def test_degree_two_recovers_a_quadratic_system_and_degree_one_cannot():
    train, (test,) = quadratic(6, 0), quadratic(1, 3)
    errors = {}
    for degree in (1, 2):
        rival = LinearRival(train, step=STEP, lags=1, degree=degree, ridge=1e-12)
        x = rival.predict(test.states("qv")[0], test.t, Signal(test.t, test.u, "hold"))
        errors[degree] = float((x[:, :1] - test.q).abs().max())
    assert errors[2] < 1e-6
    assert errors[1] > 1e-3
