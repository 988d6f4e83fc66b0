"""What every mechanical network must satisfy outside the data that it was scaled to.

Inherit :class:`OutsideTheDataContract` in a test class and override the ``system`` fixture.
"""

import pytest
import torch
from scipy.integrate import solve_ivp

from pinn_dyn.mechanics import MechanicalSystem


class OutsideTheDataContract:
    """The suite, at states up to ``times`` the range of the data."""

    times = 5.0
    smallest = 0.05
    """Of the eigenvalues of M anywhere, in units of the smallest on the data."""
    largest = 4.0
    """Of the eigenvalues of M anywhere, in units of the largest on the data."""
    duration = 20.0
    """Duration of a rollout without input, s."""
    tolerance = 1e-5
    """Of the integrator, relative."""

    @pytest.fixture
    def system(self) -> MechanicalSystem:
        """The network, in float64."""
        raise NotImplementedError("override the fixture 'system'")

    @pytest.fixture
    def ranges(self, system):
        """Smallest and largest of (q, v) or (q, p) in the data, ``(2, 2N)``."""
        raise NotImplementedError("override the fixture 'ranges'")

    @pytest.fixture
    def seen(self):
        """Configurations of the data, ``(K, N)``, that the network has its limits from."""
        raise NotImplementedError("override the fixture 'seen'")

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
