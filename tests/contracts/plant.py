"""What every plant of a closed loop must satisfy.

Inherit :class:`PlantContract` in a test class and override the ``plant`` and ``states`` fixtures.
"""

import pytest
import torch


class PlantContract:
    @pytest.fixture
    def plant(self):
        """The implementation."""
        raise NotImplementedError("override the fixture 'plant'")

    @pytest.fixture
    def states(self, plant):
        """Two initial states (q, v), ``(2, N)`` each, float64."""
        generator = torch.Generator().manual_seed(0)
        size = (2, plant.num_coordinates)
        q, v = (0.3 * torch.rand(size, generator=generator, dtype=torch.float64) for _ in range(2))
        return q, v

    @pytest.fixture
    def u(self, plant):
        generator = torch.Generator().manual_seed(1)
        return torch.randn(2, plant.num_inputs, generator=generator, dtype=torch.float64)

    def test_it_moves_with_its_velocity(self, plant, states, u):
        plant.start(*states)
        q, v = plant.advance(u, 0.002)
        assert q.shape == v.shape == (2, plant.num_coordinates)
        assert q.dtype == v.dtype == torch.float64
        mean = (states[1] + v) / 2
        # The trapezoidal rule errs with the change of v; a first-order step with all of it.
        change = (v - states[1]).abs().max()
        assert ((q - states[0]) / 0.002 - mean).abs().max() <= 0.51 * change + 1e-9

    def test_the_same_run_again_gives_the_same_states(self, plant, states, u):
        runs = []
        for _ in range(2):
            plant.start(*states)
            runs.append([plant.advance(u, 0.01) for _ in range(3)])
        for one, other in zip(*runs, strict=True):
            assert torch.equal(one[0], other[0])
            assert torch.equal(one[1], other[1])

    def test_copies_do_not_know_each_other(self, plant, states, u):
        """To the tolerance of a solver whose steps all copies share."""
        plant.start(*states)
        both = torch.cat(plant.advance(u, 0.01), -1)
        for k in range(2):
            plant.start(*(value[k : k + 1] for value in states))
            alone = torch.cat(plant.advance(u[k : k + 1], 0.01), -1)
            torch.testing.assert_close(both[k : k + 1], alone, rtol=1e-5, atol=1e-6)

    def test_what_it_is_given_stays_as_it_is(self, plant, states, u):
        before = [value.clone() for value in (*states, u)]
        plant.start(*states)
        q, v = plant.advance(u, 0.01)
        kept = q.clone(), v.clone()
        plant.advance(u, 0.01)
        for value, was in zip((*states, u, q, v), (*before, *kept), strict=True):
            assert torch.equal(value, was)

    def test_an_input_that_is_not_finite_costs_its_own_copy_alone(self, plant, states, u):
        broken = u.clone()
        broken[0, 0] = torch.nan
        plant.start(*states)
        q, _ = plant.advance(broken, 0.01)
        assert q[0].isnan().any()
        assert q[1].isfinite().all()

    @pytest.mark.parametrize(("duration", "name"), [(0.0, "duration"), (-1.0, "duration")])
    def test_a_duration_that_is_not_positive_is_refused(self, plant, states, u, duration, name):
        plant.start(*states)
        with pytest.raises(ValueError, match=name):
            plant.advance(u, duration)

    def test_states_and_inputs_of_another_size_are_refused(self, plant, states, u):
        with pytest.raises(ValueError, match="q"):
            plant.start(states[0][:, :-1], states[1])
        plant.start(*states)
        with pytest.raises(ValueError, match="u"):
            plant.advance(u[:, :-1], 0.01)
