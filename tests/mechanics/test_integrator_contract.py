"""Every integrator meets the contract."""

import pytest

from pinn_dyn.mechanics import RK4, Rosenbrock
from pinn_dyn.testing import IntegratorContract


class TestIntegrators(IntegratorContract):
    @pytest.fixture(params=[RK4, Rosenbrock], ids=lambda kind: kind.__name__)
    def kind(self, request):
        return request.param
