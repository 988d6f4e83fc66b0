"""The base class's automatic differentiation, on a system that gives only the four terms.

And the closed formulas of the linear system, which many tests move.
"""

import pytest
import torch

from pinn_dyn.testing import LinearSystem, MechanicalSystemContract, damped_oscillators
from tests.support.cart_pole import CartPole
from tests.support.contracts import one_case


@one_case
class TestLinearSystem(MechanicalSystemContract):
    @pytest.fixture
    def system(self):
        return damped_oscillators()


class SlidingMasses(LinearSystem):
    """Masses with dry friction, which a linear system does not have."""

    def friction_force(self, v):
        return 0.8 * torch.tanh(v / 0.3)

    def friction_slope(self, v):
        return 0.8 / 0.3 * (1 - torch.tanh(v / 0.3) ** 2)


@one_case
class TestDryFriction(MechanicalSystemContract):
    @pytest.fixture(params=["qv", "qp"])
    def system(self, request):
        values = [[2.0, 0.3], [0.3, 1.0]]
        return SlidingMasses(values, values, values, [[1.0], [0.5]], state=request.param)


@one_case
class TestCartPole(MechanicalSystemContract):
    @pytest.fixture(params=["qv", "qp"])
    def system(self, request):
        return CartPole(state=request.param)
