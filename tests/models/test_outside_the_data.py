"""Outside the data: finite accelerations, a mass as on the data, and energy that is only lost."""

from functools import partial
from pathlib import Path

import pytest
import torch

from pinn_dyn.models import (
    ConstantCholesky,
    CoulombFriction,
    LagrangianNetwork,
    NetworkCholesky,
    NetworkInput,
    NetworkPotential,
    Positive,
    Statistics,
)
from pinn_dyn.models.output_limits import (
    output_limits,
    set_output_limits,
)
from tests.models.builders import (
    CHAIN,
    make_statistics,
    make_structured,
)
from tests.support.contracts import slow_except
from tests.support.outside_the_data import OutsideTheDataContract

N = 2
MASSES = {
    "network": partial(NetworkCholesky, hidden=[6, 5]),
    "constant": ConstantCholesky,
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


def limited(model, seen):
    """The model, as a training on configurations ``seen`` leaves it."""
    set_output_limits(model, output_limits(model, seen))
    return model


def ranges_of(data, state="qv"):
    """Smallest and largest of (q, v) or (q, p)."""
    second = data.v_std if state == "qv" else data.p_std
    return torch.stack([torch.cat([data.q_low, -3 * second]), torch.cat([data.q_high, 3 * second])])


def along_a_line(data, count=200):
    """Configurations of data that fill a line from corner to corner of their box, not the box."""
    place = torch.linspace(0, 1, count, dtype=torch.float64)[:, None]
    return data.q_low + place * (data.q_high - data.q_low)


class MechanicalNetwork(OutsideTheDataContract):
    """The ranges of the builders' data."""

    size = N

    @pytest.fixture
    def data(self):
        return make_statistics(self.size, 1)

    @pytest.fixture
    def ranges(self, system, data):
        return ranges_of(data, system.state)

    @pytest.fixture
    def seen(self, data):
        return along_a_line(data)


@pytest.mark.parametrize("case", slow_except(CASES, ["lnn qv network", "hnn qp network"]))
class TestOutsideTheData(MechanicalNetwork):
    @pytest.fixture
    def system(self, case, seen):
        kind, state, mass = CASES[case]
        if case.endswith(("constant", "fixed")):
            self.duration = 5.0  # the same mass everywhere
        model = make_structured(kind, N, 1, mass=mass, friction=CoulombFriction, state=state)
        return limited(model, seen)


@pytest.mark.parametrize("kind", slow_except(CHAIN, ["lnn"]))
class TestASerialChain(MechanicalNetwork):
    """With the chain's mass and potential."""

    size = 3
    duration = 5.0  # it turns several times a second

    @pytest.fixture
    def system(self, kind, seen):
        return limited(make_structured(kind, **CHAIN[kind] | {"m": 1}), seen)


class TestATrainedNetwork(OutsideTheDataContract):
    """Of the one-segment arm over the paper's range: 2,500 steps, heads of 24 units.

    Its checkpoint as the training left it, with scales, 500 of the training configurations and the
    largest speeds. Without limits its smallest eigenvalue falls to less than a thousandth.
    """

    duration = 2.0  # a fast motion: its frequency is a hundred times that of the data

    @pytest.fixture
    def trained(self):
        return torch.load(Path(__file__).with_name("trained_lnn.pt"), weights_only=True)

    @pytest.fixture
    def seen(self, trained):
        return trained["q"].double()

    @pytest.fixture
    def ranges(self, trained):
        data, speed = Statistics.from_dict(trained["statistics"]), trained["speed"].double()
        return torch.stack([torch.cat([data.q_low, -speed]), torch.cat([data.q_high, speed])])

    @pytest.fixture
    def system(self, trained):
        model = LagrangianNetwork(
            Statistics.from_dict(trained["statistics"]),
            mass=partial(NetworkCholesky, hidden=[24, 24]),
            potential=partial(NetworkPotential, hidden=[16, 16]),
            damping=partial(NetworkCholesky, hidden=[16, 16], positivity=Positive(floor=0.0)),
            input=partial(NetworkInput, hidden=[16]),
        )
        set_output_limits(model, trained["weights"])
        model.load_state_dict(trained["weights"])
        return model.double()

    def test_limits_change_nothing_on_the_data(self, system, seen):
        found = system.mass_matrix(seen)
        set_output_limits(system, {})
        torch.testing.assert_close(found, system.mass_matrix(seen), rtol=1e-6, atol=0)

    def test_without_limits_the_mass_would_vanish(self, system, seen, ranges):
        shown = torch.linalg.eigvalsh(system.mass_matrix(seen)).min()
        set_output_limits(system, {})
        far = system.mass_matrix(self.states(ranges, self.times, 4000)[:, :3])
        assert float(torch.linalg.eigvalsh(far).min()) < 1e-3 * float(shown)
