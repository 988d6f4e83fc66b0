"""Black box with a memory: equations, and the past in evaluation and training."""

import dataclasses

import numpy as np
import pytest
import torch

from pinn_dyn.data.windows import draw_windows
from pinn_dyn.evaluation.prediction import predict_trajectories
from pinn_dyn.mechanics import Signal, Trajectory, stack
from pinn_dyn.models import NextStateMLP, SubspaceEncoder
from pinn_dyn.testing import assert_near
from pinn_dyn.training import IncrementLoss
from tests.models.builders import STEP, make_model, make_statistics, random_batch

T = STEP * torch.arange(5, dtype=torch.float64)


def network(part, x):
    """W x + b + MLP(x) with the weights of a part, in NumPy."""
    weight, bias = part.first.weight.numpy(), part.first.bias.numpy()
    outputs = len(part.layers[-1].bias)
    linear, h = np.split(weight @ x + bias, [outputs])
    for layer in part.layers:
        h = layer.weight.numpy() @ np.tanh(h) + layer.bias.numpy()
    return linear + h


def faded(model, start, outputs):
    """States y_1, ... from the outputs at z_0, z_1, ... and the offset of the start."""
    fade, share = 1 / (1 + np.exp(-model.fade.numpy())), np.exp(10 * model.share.numpy())
    share = share / share.sum(axis=-1, keepdims=True)
    offset = start - outputs[0]
    kept = [(share * fade**k).sum(axis=-1) for k in range(1, len(outputs))]
    return [y + k * offset for y, k in zip(outputs[1:], kept, strict=True)]


def by_hand(model, q, v, u, k, steps):
    """States from sample k on, of a motion with samples a step apart."""
    s = make_statistics(2, 2)
    q_std, v_std = s.q_std.numpy(), s.v_std.numpy()
    zq, zu = (q - s.q_mean.numpy()) / q_std, (u - s.u_mean.numpy()) / s.u_std.numpy()
    past = [*zq[k - 3 : k][::-1].flat, *zu[k - 3 : k + 1][::-1].flat]
    z = network(model.encoder, np.array([*zq[k], *(v[k] / v_std), *past]))
    start = np.concatenate([zq[k], v[k] / v_std])
    outputs = [network(model.output, z)]
    for j in range(steps):
        z = z + network(model.transition, np.concatenate([z, zu[k + j], zu[k + j + 1]]))
        outputs.append(network(model.output, z))
    y = np.array([start, *faded(model, start, outputs)])
    return np.hstack([s.q_mean.numpy() + q_std * y[:, :2], v_std * y[:, 2:]])


@pytest.fixture
def model():
    return make_model("subnet").requires_grad_(False)


def motion(samples, stride=1, seed=0):
    """A random motion with ``stride`` samples in a step."""
    generator = torch.Generator().manual_seed(seed)
    q, v, u = (torch.randn(samples, 2, generator=generator).double() for _ in range(3))
    return Trajectory(q, v, Signal(STEP / stride * torch.arange(samples).double(), u))


def test_evaluation_and_training_hand_over_the_past(model):
    """Rollouts from a piece, from windows of it, and training windows equal the equations."""
    stride = 3
    whole = motion(61, stride)
    q, v, u = (getattr(whole, key)[::stride].numpy() for key in "qvu")
    cut = slice(30, None)
    piece = stack(
        [
            Trajectory(
                *(whole.q[cut], whole.v[cut], Signal(whole.t[cut] - whole.t[30], whole.u[cut])),
                past=whole.u[12:30],
                past_q=whole.q[12:30],
            )
        ]
    )
    path = predict_trajectories(model, piece, step=STEP)
    expected = by_hand(model, q, v, u, 10, 10)
    assert_near(path.q_hat[0], torch.from_numpy(expected[:, :2]), 1e-6)
    assert_near(path.v_hat[0], torch.from_numpy(expected[:, 2:]), 1e-6)
    found = predict_trajectories(model, piece, window=5 * STEP, step=STEP).q_hat[0]
    for k in (10, 15):  # resets to a measured state
        expected = by_hand(model, q, v, u, k, 5)
        assert_near(found[k - 9 : k - 4], torch.from_numpy(expected[1:, :2]), 1e-6)
    windows = draw_windows([whole], count=40, steps=2, stride=stride, seed=0, history=3 * STEP)
    start = windows.start("qv", model.history_steps)
    states = model.predict(start, windows.t, windows.input)
    checked = 0
    for k in range(3, 18):
        for row in (windows.q == whole.q[k * stride]).all(1).nonzero():
            checked += 1
            assert_near(states[row[0]], torch.from_numpy(by_hand(model, q, v, u, k, 2)), 1e-6)
    assert checked > 5


def test_without_a_past_the_robot_was_at_rest(model):
    q, v, _, _ = random_batch(2, 2)
    u = motion(5, seed=1).u.expand(len(q), -1, -1)
    signal = Signal(T, u)
    known = torch.cat([u[:, :1].expand(-1, 3, -1), u], 1)
    before = STEP * torch.arange(-3, 5, dtype=torch.float64)
    expected = model.predict(torch.cat([q, v, q, q, q], -1), T, Signal(before, known))
    assert torch.equal(model.predict(torch.cat([q, v], -1), T, signal), expected)
    with pytest.raises(ValueError, match="x0"):
        model.predict(torch.cat([q, v, q], -1), T, signal)


def test_the_history_has_all_steps_that_fit():
    statistics = dataclasses.replace(make_statistics(2, 2), step=0.1)
    assert SubspaceEncoder(statistics, history=0.3).history_steps == 3  # 0.3 / 0.1 is below 3


def test_steps_with_a_memory_repeat_a_rollout(model):
    q, v, _, _ = random_batch(2, 2)
    u = motion(5, seed=1).u.expand(len(q), -1, -1)
    past = motion(3, seed=2).u.expand(len(q), -1, -1)
    x0 = torch.cat([q, v, *past.unbind(1)], -1)
    before = STEP * torch.arange(-3, 5, dtype=torch.float64)
    expected = model.predict(x0, T, Signal(before, torch.cat([past.flip(1), u], 1)))
    memory = model.start(q, v, u[:, 0], past.flatten(1), past.flatten(1))
    for k in range(4):
        memory, q, v = model.next_state(memory, u[:, k], u[:, k + 1])
        assert_near(torch.cat([q, v], -1), expected[:, k + 1], 1e-12)


def lagging_actuator(samples, seed):
    """A damped mass whose motor force f, which is not measured, follows u after 0.4 s."""
    generator = torch.Generator().manual_seed(seed)
    u = torch.randn(samples // 25 + 1, 1, generator=generator).double()
    u = u.repeat_interleave(25, 0)[:samples]
    x, states = torch.zeros(3).double(), []
    for value in u[:, 0]:
        states.append(x)
        q, v, f = x
        x = x + 0.02 * torch.stack([v, f - 4 * q - v, (value - f) / 0.4])
    states = torch.stack(states)
    t = 0.02 * torch.arange(samples, dtype=torch.float64)
    return Trajectory(states[:, :1], states[:, 1:2], Signal(t, u, "hold"))


def test_the_memory_finds_an_actuator_state_that_is_not_measured():
    train, test = lagging_actuator(3000, 0), lagging_actuator(1001, 1)
    windows = draw_windows([train], count=2000, steps=10, stride=5, seed=0, history=0.5)
    windows = windows.to(torch.device("cpu"), torch.float32)
    errors = {}
    for kind in (SubspaceEncoder, NextStateMLP):
        torch.manual_seed(0)
        options = {"history": 0.5, "latent": 4} if kind is SubspaceEncoder else {}
        model = kind(windows.statistics(), hidden=[16], activation="tanh", **options)
        loss = IncrementLoss(windows.statistics(), model)
        optimizer = torch.optim.Adam(model.parameters(), lr=0.01)
        for step in range(200):
            optimizer.zero_grad()
            loss(model, windows[torch.arange(100) + 100 * (step % 20)]).backward()
            optimizer.step()
        prediction = predict_trajectories(model, stack([test]), window=1.0, step=0.1)
        errors[kind] = float(prediction.error().mean())
    assert errors[SubspaceEncoder] < 0.5 * errors[NextStateMLP]
