"""The contract of a mechanical system, for the learned ones with every kind of head."""

import pytest

from tests.contracts.mechanical_system import MechanicalSystemContract
from tests.models.builders import TRANSPOSED, VARIANTS, make_structured


@pytest.mark.parametrize("variant", VARIANTS)
class TestLagrangianNetwork(MechanicalSystemContract):
    @pytest.fixture
    def system(self, variant):
        return make_structured("lnn", **VARIANTS[variant])


@pytest.mark.parametrize("variant", VARIANTS)
class TestHamiltonianNetwork(MechanicalSystemContract):
    @pytest.fixture
    def system(self, variant):
        return make_structured("hnn", **VARIANTS[variant])


class TestTransposedMass(MechanicalSystemContract):
    @pytest.fixture
    def system(self):
        return make_structured("lnn", **TRANSPOSED)
