"""Every head of potential, input and residual keeps the contract of its kind."""

from functools import partial

import pytest
import torch

from pinn_dyn.models import (
    ChainPotential,
    ConstantInput,
    FixedInput,
    NetworkInput,
    NetworkPotential,
    NetworkResidual,
    NonlinearInput,
)
from pinn_dyn.testing import (
    InputMatrixContract,
    PotentialContract,
    ResidualContract,
)
from tests.models.builders import make_scales, perturb
from tests.support.contracts import one_case

SIZE = 3
FORCE = torch.tensor([0.5, 2.0, 3.0], dtype=torch.float64)


def make(builder, value, inputs=2, angles=()):
    torch.manual_seed(3)
    scales = make_scales(SIZE, inputs, value, angles)
    return perturb(builder(scales).double(), spread=0.4)


POTENTIALS = {
    "network": partial(NetworkPotential, hidden=[5, 4]),
    "without a well": partial(NetworkPotential, hidden=[5], activation="tanh", quadratic=False),
    "chain": partial(ChainPotential, rank=4),
}


@pytest.mark.parametrize("name", POTENTIALS)
@one_case
class TestPotential(PotentialContract):
    @pytest.fixture
    def head(self, name):
        angles = (0, 1, 2) if name == "chain" else (1,)
        return make(POTENTIALS[name], 2.5, angles=angles)


INPUTS = {
    "network": partial(NetworkInput, hidden=[4]),
    "constant": ConstantInput,
    "fixed": partial(FixedInput, value=[[1.0, 0.5], [0.0, -2.0], [3.0, 0.0]]),
    "nonlinear": partial(NonlinearInput, hidden=[4], activation="tanh"),
    "nonlinear in one": partial(NonlinearInput, hidden=[4], activation="tanh", linear=[0]),
}


@pytest.mark.parametrize("name", INPUTS)
@one_case
class TestInput(InputMatrixContract):
    @pytest.fixture
    def head(self, name):
        return make(INPUTS[name], [0.5, 3.0])


@one_case
class TestResidual(ResidualContract):
    @pytest.fixture
    def head(self):
        return make(partial(NetworkResidual, hidden=[5]), FORCE)
