"""Trajectories: what they accept, and how they are cut and stacked."""

import dataclasses

import pytest
import torch

from pinn_dyn.mechanics import Signal, Trajectory, stack, stack_until


def twice(q, v):
    """p of a body of 2 kg."""
    return 2 * v


def trajectory(samples=11, step=0.1, start=0.0, batch=(), **changes):
    generator = torch.Generator().manual_seed(0)

    def values(size):
        return torch.randn(*batch, samples, size, generator=generator, dtype=torch.float64)

    fields = {
        "t": start + step * torch.arange(samples, dtype=torch.float64),
        "q": values(3),
        "v": values(3),
        "u": values(2),
        "interpolation": "linear",
        "momentum": twice,
    }
    fields |= changes
    signal = Signal(fields["t"], fields["u"], fields["interpolation"])
    return Trajectory(fields["q"], fields["v"], signal, momentum=fields["momentum"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"v": torch.zeros(11, 2)}, r"^v has shape \(11, 2\), expected \(11, 3\)"),
        ({"u": torch.zeros(10, 2)}, r"^u has shape \(10, 2\), expected \(\*batch, 11, M\)"),
    ],
)
def test_fields_that_do_not_match_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        trajectory(**changes)


def test_state_stacks_configuration_and_velocity_or_momentum():
    item = trajectory(batch=(2,))
    for state, second in (("qv", item.v), ("qp", 2 * item.v)):
        found = item.states(state)
        assert torch.equal(found[..., :3], item.q)
        assert torch.equal(found[..., 3:], second)
        assert torch.equal(item.states(state, slice(2, 9, 3)), found[:, 2:9:3])


@pytest.mark.parametrize("known", [0, 2, 5])
def test_input_history_is_the_latest_input_before_the_start(known):
    """Three samples of 0.1 s are needed. Where fewer are known, the earliest value is held."""
    item = trajectory()
    past = torch.arange(2.0 * known, dtype=torch.float64).reshape(known, 2)
    signal = dataclasses.replace(item, past=past if known else None).since(0.25).input
    torch.testing.assert_close(signal.t[:4], torch.tensor([-0.3, -0.2, -0.1, 0.0]).double())
    assert torch.equal(signal.u[3:], item.u)
    latest = past[-3:] if known else item.u[:1]
    expected = torch.cat([latest[:1].expand(3 - len(latest), 2), latest])
    assert torch.equal(signal.u[:3], expected)


@pytest.mark.parametrize(("horizon", "samples"), [(1.0, 11), (0.5, 6), (0.3, 4), (0.1, 2)])
@pytest.mark.parametrize("start", [0.0, 7.3])
def test_until_keeps_the_sample_at_the_horizon(horizon, samples, start):
    """0.3 is not 3 * 0.1 in floating point; half a step of tolerance settles it."""
    whole = trajectory(start=start, batch=(2,), interpolation="hold")
    part = whole.until(horizon)
    assert part.duration == pytest.approx(horizon)
    assert part.input.interpolation == "hold"
    assert torch.equal(part.t, whole.t[:samples])
    assert part.momentum is twice
    for name in ("q", "v", "u"):
        assert torch.equal(getattr(part, name), getattr(whole, name)[:, :samples]), name


def test_stack_adds_a_batch_dimension_and_starts_at_zero():
    early, late = trajectory(), trajectory(start=100.0)
    both = stack([early, late])
    assert both.q.shape == (2, 11, 3)
    assert both.t[0] == 0
    torch.testing.assert_close(both.t, early.t)
    assert torch.equal(both.u[1], late.u)
    assert both.momentum is twice


def test_of_unequal_lengths_those_are_stacked_that_last_long_enough():
    three = [trajectory(samples=count) for count in (11, 6, 8)]
    assert stack_until(three).q.shape[:2] == (3, 6)
    longer = stack_until(three, 0.7)
    assert longer.q.shape[:2] == (2, 8)
    assert torch.equal(longer.q[1], three[2].q)
    with pytest.raises(ValueError, match=r"horizon is 2.0 s, but the trajectory lasts only 1 s"):
        stack_until(three, 2.0)
