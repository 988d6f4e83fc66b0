"""Outside the data: finite accelerations, a mass as on the data, and energy that is only lost."""

from functools import partial
from pathlib import Path

import pytest
import torch

from pinn_dyn.models import (
    Bounded,
    ChainPotential,
    ConstantCholesky,
    CoulombFriction,
    FixedCholesky,
    KnownAndNetwork,
    KnownMechanics,
    LagrangianNetwork,
    NetworkCholesky,
    NetworkInput,
    NetworkPotential,
    NoInput,
    Positive,
    Statistics,
)
from pinn_dyn.models.output_limits import (
    expect_output_limits,
    output_limits,
    set_output_limits,
)
from pinn_dyn.systems import RigidChain
from tests.models.builders import (
    CHAIN,
    TRANSPOSED,
    make_statistics,
    make_structured,
    perturb,
    positive_matrix,
)
from tests.support.known import statistics as unit_statistics
from tests.support.outside_the_data import OutsideTheDataContract
from tests.support.rigid_chains import TREE

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


@pytest.mark.parametrize("case", CASES)
class TestOutsideTheData(MechanicalNetwork):
    @pytest.fixture
    def system(self, case, seen):
        kind, state, mass = CASES[case]
        if case.endswith(("constant", "fixed")):
            self.duration = 10.0  # the same mass everywhere: the longest motions show no more
        model = make_structured(kind, N, 1, mass=mass, friction=CoulombFriction, state=state)
        return limited(model, seen)


class TestWithAnAngle(MechanicalNetwork):
    duration = 2.0  # it turns several times a second

    @pytest.fixture
    def system(self, seen):
        model = make_structured("lnn", N, 1, friction=CoulombFriction, angles=[0])
        return limited(model, seen)


class TestThreeCoordinates(MechanicalNetwork):
    size = 3
    duration = 20.0

    @pytest.fixture
    def system(self, seen):
        settings = TRANSPOSED | {"m": 1, "friction": CoulombFriction}
        return limited(make_structured("lnn", **settings), seen)


@pytest.mark.parametrize("kind", CHAIN)
class TestASerialChain(MechanicalNetwork):
    """With the chain's mass and potential."""

    size = 3
    duration = 5.0  # it turns several times a second

    @pytest.fixture
    def system(self, kind, seen):
        return limited(make_structured(kind, **CHAIN[kind] | {"m": 1}), seen)


class TestKnownMechanicsAndNetwork(MechanicalNetwork):
    """Learned constants of bodies, and a network on top; a slider, so M of the bodies is unbounded.

    The contract's bounds are of the network's share.
    """

    size = 4
    duration = 5.0  # it turns several times a second

    @pytest.fixture
    def data(self):
        return unit_statistics(self.size)

    @pytest.fixture
    def system(self, seen):
        chain = partial(RigidChain, TREE, locked_joints=["wrist"])
        network = partial(
            LagrangianNetwork,
            mass=partial(NetworkCholesky, hidden=[6]),
            potential=partial(NetworkPotential, hidden=[6]),
            damping=partial(NetworkCholesky, hidden=[6], positivity=Positive(floor=0.0)),
            input=NoInput,
            friction=CoulombFriction,
        )
        known = partial(KnownMechanics, structure=chain())
        model = KnownAndNetwork(unit_statistics(self.size), known, network)
        model = perturb(model.double(), spread=0.2)
        # It is built in single precision, in which rotations are no longer exact.
        model.known.structure = chain()
        return limited(model, seen)

    def test_the_mass_is_nowhere_much_smaller_or_larger_than_on_the_data(
        self, system, ranges, seen
    ):
        network = system.parts["network"]
        super().test_the_mass_is_nowhere_much_smaller_or_larger_than_on_the_data(
            network, ranges, seen
        )


class TestATrainedNetwork(OutsideTheDataContract):
    """Of the one-segment arm over the paper's range: 2,500 steps, heads of 24 units.

    Its checkpoint as the training left it, with scales, 500 of the training configurations and the
    largest speeds. Without limits its smallest eigenvalue falls to less than a thousandth.
    """

    duration = 5.0  # a fast motion: its frequency is a hundred times that of the data

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
        expect_output_limits(model, trained["weights"])
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


def test_a_potential_of_a_chain_stays_bounded():
    """Linear in the sine and cosine of each joint, so periodic: nothing to limit."""
    potential = partial(ChainPotential, rank=4)
    model = make_structured("lnn", 3, 1, potential=potential, angles=[0, 1, 2])
    q = along_a_line(make_statistics(3, 1))
    turn = 2 * torch.pi * torch.tensor([1.0, -2.0, 30.0], dtype=torch.float64)
    with torch.no_grad():
        expected = model.potential_energy(q)
        torch.testing.assert_close(model.potential_energy(q + turn), expected, rtol=0, atol=1e-9)
