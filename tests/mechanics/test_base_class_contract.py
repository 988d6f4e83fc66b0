"""The base class's automatic differentiation, on a system that gives only the four terms.

And the closed formulas of the linear system, which many tests move.
"""

import pytest

from pinn_dyn.testing import MechanicalSystemContract, damped_oscillators
from tests.support.cart_pole import CartPole


class TestLinearSystem(MechanicalSystemContract):
    @pytest.fixture
    def system(self):
        return damped_oscillators()


class TestCartPole(MechanicalSystemContract):
    @pytest.fixture(params=["qv", "qp"])
    def system(self, request):
        return CartPole(state=request.param)
