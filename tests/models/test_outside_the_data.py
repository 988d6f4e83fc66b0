"""Outside the data: finite accelerations, a mass as on the data, and energy that is only lost."""

from functools import partial
from pathlib import Path

import pytest
import torch
from scipy.integrate import solve_ivp

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
from pinn_dyn.models.cholesky import output_limits, set_output_limits
from tests.models.builders import CHAIN, make_statistics, make_structured
from tests.support.contracts import slow_except

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


class OutsideTheData:
    """Requirements of a network ``system`` at states up to ``times`` the range of its data.

    ``ranges`` are the smallest and largest (q, v) or (q, p) in the data, ``(2, 2N)``, and ``seen``
    are the configurations, ``(K, N)``, that the network has its limits from.
    """

    times = 5.0
    smallest, largest = 0.05, 4.0
    """Eigenvalues of M anywhere, in units of the smallest and the largest on the data."""
    duration, tolerance = 20.0, 1e-5
    """Duration of a rollout without input, s, and relative tolerance of its integrator."""

    @pytest.fixture(autouse=True)
    def _values_only(self):
        with torch.no_grad():
            yield

    def states(self, ranges, times, count, seed=0):
        """Uniform over ``times`` the range of the data."""
        generator = torch.Generator().manual_seed(seed)
        low, high = ranges
        place = 2 * torch.rand(count, len(low), generator=generator, dtype=torch.float64) - 1
        return (low + high) / 2 + times * place * (high - low) / 2

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_a_thousand_far_states_have_finite_accelerations(self, system, ranges, dtype):
        q, v = self.states(ranges, self.times, 1000).to(dtype).chunk(2, -1)
        model = system.to(dtype)
        u = torch.ones(1000, model.num_inputs, dtype=dtype)
        assert torch.isfinite(model.forward_dynamics(q, v, u)).all()
        assert torch.isfinite(model.state_derivative(torch.cat([q, v], -1), u)).all()

    def test_the_mass_is_nowhere_much_smaller_or_larger_than_on_the_data(
        self, system, ranges, seen
    ):
        """Over all q: the corners of the box that no motion has been in, its edges and far out."""
        n = system.num_coordinates
        shown = torch.linalg.eigvalsh(system.mass_matrix(seen))
        for times in (1.0, 1.2, 2.0, self.times, 100.0):
            q = self.states(ranges, times, 4000)[:, :n]
            found = torch.linalg.eigvalsh(system.mass_matrix(q))
            assert float(found.min()) > self.smallest * float(shown.min()), times
            assert float(found.max()) < self.largest * float(shown.max()), times

    def test_without_input_energy_is_only_lost(self, system, ranges):
        """Along rollouts from far outside, by an adaptive integrator: E never grows."""
        n, count = system.num_coordinates, 1
        x0 = self.states(ranges, self.times, count, seed=1)
        u = torch.zeros(count, system.num_inputs, dtype=torch.float64)

        def derivative(t, flat):
            x = torch.from_numpy(flat).reshape(count, 2 * n)
            return system.state_derivative(x, u).reshape(-1).numpy()

        solution = solve_ivp(
            derivative,
            (0, self.duration),
            x0.reshape(-1).numpy(),
            method="LSODA",
            rtol=self.tolerance,
            atol=1e-3 * self.tolerance,
        )
        assert solution.success, solution.message
        x = torch.from_numpy(solution.y.T.copy()).reshape(-1, count, 2 * n)
        q, v = x.chunk(2, -1)
        if system.state == "qp":
            v = system.velocity(q, v)
        energy = system.total_energy(q, v)
        assert torch.isfinite(energy).all()
        spent = energy[0] - energy.amin(0)
        assert (spent > 0).all()
        # The integrator's error grows with the number of steps.
        gained = (energy - energy.cummin(0).values).amax(0)
        assert (gained < 1e2 * self.tolerance * spent).all(), (gained / spent).tolist()


class MechanicalNetwork(OutsideTheData):
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


class TestATrainedNetwork(OutsideTheData):
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
