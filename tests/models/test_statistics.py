"""The scales of the data."""

import json
from dataclasses import fields
from functools import partial

import torch

from pinn_dyn.models import (
    ConstantCholesky,
    CoulombFriction,
    FixedInput,
    LagrangianNetwork,
    NetworkPotential,
    Statistics,
)
from tests.models.builders import make_statistics


def test_a_dictionary_gives_the_same_statistics_back():
    statistics = make_statistics(3, 2)
    # Through JSON: plain lists and numbers only, every digit kept.
    back = Statistics.from_dict(json.loads(json.dumps(statistics.to_dict())))
    for item in fields(Statistics):
        before, after = getattr(statistics, item.name), getattr(back, item.name)
        assert type(after) is type(before), item.name
        if isinstance(before, torch.Tensor):
            assert after.dtype == before.dtype, item.name
            assert torch.equal(after, before), item.name
        else:
            assert after == before, item.name


def test_heads_start_at_the_scales_of_the_data():
    """With f the RMS of A u: V ~ f q, D ~ f/v and F ~ f, each in the mean over coordinates."""
    data, scales = make_statistics(2, 2), {}
    A = torch.tensor([[2.0, -1.0], [0.5, 3.0]]).double()

    def recorded(name, head):
        def build(given):
            scales[name] = given.value
            return head(given)

        return build

    LagrangianNetwork(
        data,
        mass=ConstantCholesky,
        potential=recorded("V", partial(NetworkPotential, hidden=[3])),
        damping=recorded("D", ConstantCholesky),
        friction=recorded("F", CoulombFriction),
        input=partial(FixedInput, value=A.tolist()),
    )
    # Each input is its mean plus or minus its standard deviation: four equally likely inputs.
    signs = torch.tensor([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    u = data.u_mean + signs * data.u_std
    torch.testing.assert_close(data.u_rms, u.square().mean(0).sqrt())
    uncorrelated = A.square() @ u.square().mean(0)
    torch.testing.assert_close(scales["F"], uncorrelated.sqrt())
    torch.testing.assert_close(scales["D"], (uncorrelated.sqrt() / data.v_std).sqrt())
    torch.testing.assert_close(scales["V"], uncorrelated.mean().sqrt() * data.q_std.mean())
