"""Every loss meets the contract."""

from functools import partial

import pytest

from pinn_dyn.testing import WindowLossContract
from pinn_dyn.training import IncrementLoss, MidpointLoss
from tests.support.contracts import one_case

LOSSES = {
    "increment": IncrementLoss,
    "increment, huber": partial(IncrementLoss, huber=0.3),
    "midpoint": MidpointLoss,
}


@one_case
class TestLosses(WindowLossContract):
    @pytest.fixture(params=LOSSES.values(), ids=LOSSES)
    def make(self, request):
        return request.param
