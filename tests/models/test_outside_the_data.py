"""Outside the data: finite accelerations, a mass as near the data, and energy that is only lost."""

from functools import partial

import pytest
import torch

from pinn_dyn.models import (
    Bounded,
    ConstantCholesky,
    CoulombFriction,
    FixedCholesky,
    NetworkCholesky,
)
from tests.contracts.outside_the_data import OutsideTheDataContract
from tests.models.builders import make_statistics, make_structured, positive_matrix

N = 2
MASSES = {
    "network": partial(NetworkCholesky, hidden=[6, 5]),
    "bounded": partial(NetworkCholesky, hidden=[6], positivity=Bounded(3.5)),
    "constant": ConstantCholesky,
    "fixed": partial(FixedCholesky, value=positive_matrix(N)),
}
CASES = {
    **{
        f"{kind} {state} {name}": (kind, state, mass)
        for kind, state in (("lnn", "qv"), ("hnn", "qp"), ("hnn", "qv"))
        for name, mass in MASSES.items()
    },
    "lnn qv transposed": (
        "lnn", "qv", partial(NetworkCholesky, hidden=[6], transposed=True),
    ),
}  # fmt: skip


class MechanicalNetwork(OutsideTheDataContract):
    """The ranges of the builders' data."""

    @pytest.fixture
    def ranges(self, system):
        data = make_statistics(N, 1)
        second = data.v_std if system.state == "qv" else data.p_std
        return torch.stack(
            [torch.cat([data.q_low, -3 * second]), torch.cat([data.q_high, 3 * second])]
        )


@pytest.mark.parametrize("case", CASES)
class TestOutsideTheData(MechanicalNetwork):
    @pytest.fixture
    def system(self, case):
        kind, state, mass = CASES[case]
        return make_structured(kind, N, 1, mass=mass, friction=CoulombFriction, state=state)


class TestWithAnAngle(MechanicalNetwork):
    duration = 5.0  # it turns several times a second

    @pytest.fixture
    def system(self):
        return make_structured("lnn", N, 1, friction=CoulombFriction, angles=[0])
