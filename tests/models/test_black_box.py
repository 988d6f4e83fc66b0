"""The black boxes: normalization, steps and sample times."""

import pytest
import torch

from pinn_dyn.mechanics import Signal
from pinn_dyn.testing import assert_near
from tests.models.builders import STEP, make_model, make_statistics, random_batch

T = STEP * torch.arange(5, dtype=torch.float64)


@pytest.fixture
def model():
    return make_model("next_state").requires_grad_(False)


@pytest.fixture
def start():
    q, v, _, _ = random_batch(2, 2)
    return torch.cat([q, v], -1)


@pytest.fixture
def inputs():
    generator = torch.Generator().manual_seed(6)
    return torch.randn(6, 5, 2, generator=generator, dtype=torch.float64)


def step_by_hand(model, x, u, u_next):
    """One step with the normalization written out."""
    s = make_statistics(2, 2)
    first = torch.cat([(x[:, :2] - s.q_mean) / s.q_std, x[:, 2:] / s.v_std], -1)
    h = torch.cat([first, (u - s.u_mean) / s.u_std, (u_next - s.u_mean) / s.u_std], -1)
    for k, layer in enumerate(model.network.layers):
        h = layer(torch.nn.functional.softplus(h) if k else h)
    return x + s.qv_increment_std[0] * h


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
def test_a_step_takes_the_inputs_at_its_ends(model, start, inputs, interpolation):
    """With "hold" the input of the step's start holds up to its end."""
    x, path = start, [start]
    for k in range(4):
        after = inputs[:, k if interpolation == "hold" else k + 1]
        x = step_by_hand(model, x, inputs[:, k], after)
        path.append(x)
    actual = model.predict(start, T, Signal(T, inputs, interpolation))
    # The scales are kept in float32.
    assert_near(actual, torch.stack(path, 1), 1e-6)


def test_inputs_may_be_sampled_more_finely_than_the_steps(model, start, inputs):
    fine_times = STEP / 4 * torch.arange(17, dtype=torch.float64)
    fine = torch.full((6, 17, 2), 99.0, dtype=torch.float64)
    fine[:, ::4] = inputs
    expected = model.predict(start, T, Signal(T, inputs))
    assert torch.equal(model.predict(start, T, Signal(fine_times, fine)), expected)
    shifted = model.predict(start, T + 7, Signal(fine_times + 7, fine))
    assert_near(shifted, expected, 1e-9)
    part = model.predict(start, T[1:3], Signal(fine_times, fine))
    assert_near(part, model.predict(start, T[:2], Signal(T[:2], inputs[:, 1:3])), 1e-9)


def test_a_wrong_step_is_refused_with_the_right_one(model, start, inputs):
    with pytest.raises(ValueError, match=r"in steps of 0\.02 s.*t advances by 0\.04 to 0\.04 s"):
        model.predict(start, 2 * T, Signal(2 * T, inputs))
    uneven = T.clone()
    uneven[2] += 0.3 * STEP
    with pytest.raises(ValueError, match=r"advances by 0\.014 to 0\.026 s"):
        model.predict(start, uneven, Signal(uneven, inputs))


def test_acceleration_is_scaled_by_the_data_and_velocity_is_exact(start):
    model = make_model("acceleration").requires_grad_(False)
    s = make_statistics(2, 2)
    u = torch.full((6, 2), 0.3, dtype=torch.float64)
    features = torch.cat(
        [(start[:, :2] - s.q_mean) / s.q_std, start[:, 2:] / s.v_std, (u - s.u_mean) / s.u_std], -1
    )
    for k, layer in enumerate(model.network.layers):
        features = layer(torch.nn.functional.softplus(features) if k else features)
    expected = s.qv_increment_std[0, 2:] / STEP * features
    rates = model.state_derivative(start, u)
    assert torch.equal(rates[:, :2], start[:, 2:])
    assert_near(rates[:, 2:], expected, 1e-6)
