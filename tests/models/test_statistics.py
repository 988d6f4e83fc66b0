"""The scales of the data."""

import json
from dataclasses import fields

import pytest
import torch

from pinn_dyn.models import Statistics
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


@pytest.mark.parametrize("repeat", [1, 2])
def test_network_input_is_state_and_inputs(repeat):
    statistics = make_statistics(3, 2)
    mean, std = statistics.network_input(repeat_input=repeat)
    assert mean.tolist() == [
        *statistics.q_mean.tolist(), 0, 0, 0, *statistics.u_mean.tolist() * repeat
    ]  # fmt: skip
    assert std.tolist() == [
        *statistics.q_std.tolist(), *statistics.v_std.tolist(), *statistics.u_std.tolist() * repeat
    ]  # fmt: skip
