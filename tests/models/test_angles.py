"""Motion is periodic in the coordinates that are angles."""

import pytest
import torch

from pinn_dyn.mechanics import Signal
from pinn_dyn.models import (
    AccelerationMLP,
    CoulombFriction,
    NextStateMLP,
)
from pinn_dyn.testing import assert_near
from tests.models.builders import (
    make_statistics,
    make_structured,
    perturb,
    random_batch,
)


def test_angles_have_their_period_and_lengths_do_not():
    model = make_structured("lnn", friction=CoulombFriction, angles=[0, 2])
    q, v, _, u = random_batch(3, 3)
    turn = torch.tensor([2.0, 0.0, -4.0], dtype=torch.float64) * torch.pi
    a = model.forward_dynamics(q, v, u)
    assert_near(model.forward_dynamics(q + turn, v, u), a, 1e-11)
    stretched = q + torch.tensor([0.0, 0.5, 0.0], dtype=torch.float64)
    assert (model.forward_dynamics(stretched, v, u) - a).abs().max() > 1e-3
    turned = q + torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64)
    assert (model.forward_dynamics(turned, v, u) - a).abs().max() > 1e-3


@pytest.mark.parametrize("kind", [AccelerationMLP, NextStateMLP])
def test_black_boxes_see_angles_too(kind):
    model = perturb(kind(make_statistics(2, 2), hidden=[6], angles=[1]).double())
    q, v, _, u = random_batch(2, 2)
    t = torch.tensor([0.0, 0.02], dtype=torch.float64)

    def increments(q):
        x0 = torch.cat([q, v], -1)
        return model.increments(x0, t, Signal(t, u[:, None].expand(-1, 2, -1)))

    turn = torch.tensor([0.0, 2 * torch.pi], dtype=torch.float64)
    assert_near(increments(q + turn), increments(q), 1e-11)
    assert (increments(q + turn.flip(0)) - increments(q)).abs().max() > 1e-4
