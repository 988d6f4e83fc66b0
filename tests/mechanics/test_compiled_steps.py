"""Compiled roll-outs against torchdiffeq's."""

import pytest
import torch

from pinn_dyn.mechanics.compiled_steps import stage_inputs
from pinn_dyn.mechanics.integration import SampledInput, rollout_increments
from tests.models.builders import make_structured
from tests.support.linear import damped_oscillators


def samples(batch, count, size, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*batch, count, size, generator=generator, dtype=torch.float64)


@pytest.fixture
def uncompiled(monkeypatch):
    """The same loop, with the step left as it is."""
    monkeypatch.setattr(torch, "compile", lambda function, **_: function)


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
@pytest.mark.parametrize("count", [1, 2, 7])
def test_stage_inputs_are_those_of_the_sampled_input(interpolation, count):
    """At random times, inside the samples and beyond both ends."""
    u = samples((2,), count, 3)
    t_input = torch.rand(count, generator=torch.Generator().manual_seed(1)).double().cumsum(0)
    signal = SampledInput(t_input, u, interpolation)
    grid = torch.linspace(-0.3, float(t_input[-1]) + 0.4, 12, dtype=torch.float64)
    found = stage_inputs(grid, t_input, u.movedim(-2, 0), interpolation)
    assert found.shape == (11, 4, 2, 3)
    for k in range(11):
        h = grid[k + 1] - grid[k]
        for stage, part in enumerate((0.0, 1 / 3, 2 / 3, 1.0)):
            expected = signal(grid[k] + part * h)
            torch.testing.assert_close(found[k, stage], expected, rtol=1e-10, atol=1e-10)


def test_the_last_stage_of_a_held_input_is_before_the_next_sample():
    t = torch.tensor([0.0, 0.1, 0.2, 0.3], dtype=torch.float64)
    u = torch.arange(4.0, dtype=torch.float64)[:, None]
    found = stage_inputs(t, t, u, "hold").squeeze(-1)
    expected = torch.arange(3.0, dtype=torch.float64)[:, None].expand(3, 4)
    torch.testing.assert_close(found, expected)


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("interpolation", ["linear", "hold"])
@pytest.mark.parametrize("batch", [(), (2, 3)])
@pytest.mark.parametrize("substeps", [1, 3])
def test_the_loop_gives_what_torchdiffeq_gives(interpolation, batch, substeps):
    """More steps than a block, an input that jumps, and solution times that skip samples."""
    system = damped_oscillators().requires_grad_(False)
    t_input = 0.02 * torch.arange(141, dtype=torch.float64)
    u = samples(batch, 141, 1)
    x0 = samples(batch, 1, 4, seed=1).squeeze(-2)
    options = dict(t_input=t_input, interpolation=interpolation, substeps=substeps)
    expected, found = (
        rollout_increments(
            system.velocity_derivative, x0, t_input[::2], u, compile=compile, **options
        )
        for compile in (False, True)
    )
    assert found.shape == (*batch, 71, 4)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lnn", "hnn"])
def test_a_compiled_roll_out_of_a_network_is_that_of_torchdiffeq(kind):
    """Two models of one shape in turn: neither may be taken for the other."""
    t = 0.002 * torch.arange(301, dtype=torch.float64)
    u, x0 = samples((), 301, 3), 0.3 * samples((), 1, 6, seed=1).squeeze(0)
    model = make_structured(kind).eval()
    other = make_structured(kind).eval()
    with torch.no_grad():
        for parameter in other.parameters():
            parameter *= 0.9
        for item in (model, other):
            expected = item.predict(x0, t, u)
            item.compiled_rollouts = True
            found = item.predict(x0, t, u)
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
            assert (expected[-1] - x0).abs().max() > 0.01
