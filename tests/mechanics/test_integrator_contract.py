"""Every integrator meets the contract."""

import pytest

from pinn_dyn.mechanics import RK4, Rosenbrock
from pinn_dyn.testing import IntegratorContract
from tests.support.contracts import one_case


@one_case
class TestIntegrators(IntegratorContract):
    @pytest.fixture(params=[RK4, Rosenbrock], ids=lambda kind: kind.__name__)
    def kind(self, request):
        return request.param
