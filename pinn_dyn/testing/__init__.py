"""Contract suites: pytest classes that test your own system, head, loss, source, law or plant.

Install pytest, inherit a suite in a test file and override its fixtures::

    from pinn_dyn.testing import MechanicalSystemContract

    class TestMyRobot(MechanicalSystemContract):
        @pytest.fixture
        def system(self):
            return MyRobot().double()
"""

import pytest

# pytest explains failed assertions in test files only, unless a module is registered.
_MODULES = "controller data_source heads integrator loss mechanical_system plant"
pytest.register_assert_rewrite(*(f"{__name__}.{module}" for module in _MODULES.split()))

from pinn_dyn.testing.controller import ControllerContract  # noqa: E402
from pinn_dyn.testing.data_source import DataSourceContract  # noqa: E402
from pinn_dyn.testing.finite_differences import (  # noqa: E402
    assert_near,
    partial_derivatives,
    slope,
)
from pinn_dyn.testing.heads import (  # noqa: E402
    CholeskyHeadContract,
    FrictionContract,
    InputMatrixContract,
    PotentialContract,
    ResidualContract,
)
from pinn_dyn.testing.integrator import IntegratorContract  # noqa: E402
from pinn_dyn.testing.linear_system import (  # noqa: E402
    LinearSystem,
    damped_oscillators,
    exact_solution,
)
from pinn_dyn.testing.loss import WindowLossContract  # noqa: E402
from pinn_dyn.testing.mechanical_system import (  # noqa: E402
    Configurations,
    MechanicalSystemContract,
)
from pinn_dyn.testing.plant import PlantContract  # noqa: E402

__all__ = [
    "CholeskyHeadContract",
    "Configurations",
    "ControllerContract",
    "DataSourceContract",
    "FrictionContract",
    "InputMatrixContract",
    "IntegratorContract",
    "LinearSystem",
    "MechanicalSystemContract",
    "PlantContract",
    "PotentialContract",
    "ResidualContract",
    "WindowLossContract",
    "assert_near",
    "damped_oscillators",
    "exact_solution",
    "partial_derivatives",
    "slope",
]
