"""Suite for plants of a closed loop. Inherit it and override ``plant`` and ``states``."""

import pytest
import torch


class PlantContract:
    """Suite for a simulator that moves copies of a robot under a held input."""

    @pytest.fixture
    def plant(self):
        """Return the implementation."""
        raise NotImplementedError("override the fixture 'plant'")

    @pytest.fixture
    def states(self, plant):
        """Return two initial states (q, v), ``(2, N)`` each, float64."""
        generator = torch.Generator().manual_seed(0)
        size = (2, plant.num_coordinates)
        q, v = (0.3 * torch.rand(size, generator=generator, dtype=torch.float64) for _ in range(2))
        return q, v

    @pytest.fixture
    def u(self, plant):
        generator = torch.Generator().manual_seed(1)
        return torch.randn(2, plant.num_inputs, generator=generator, dtype=torch.float64)

    def test_velocity_is_the_rate_of_the_configuration(self, plant, states, u):
        plant.start(*states)
        q, v = plant.advance(u, 0.002)
        assert q.shape == v.shape == (2, plant.num_coordinates)
        assert q.dtype == v.dtype == torch.float64
        mean = (states[1] + v) / 2
        # The error of a first-order step is half of the change of v.
        change = (v - states[1]).abs().max()
        assert ((q - states[0]) / 0.002 - mean).abs().max() <= 0.51 * change + 1e-9

    def test_a_repeated_run_gives_the_same_states_and_modifies_no_tensor(self, plant, states, u):
        runs = []
        tensors = (*states, u)
        before = [value.clone() for value in tensors]
        for _ in range(2):
            plant.start(*states)
            results = [x for _ in range(3) for x in plant.advance(u, 0.01)]
            runs.append(results)
            tensors += tuple(results)
            before += [value.clone() for value in results]
        for first, second in zip(*runs, strict=True):
            # Code in C may replace Python from some step on.
            torch.testing.assert_close(first, second, rtol=1e-10, atol=1e-12)
        for value, original in zip(tensors, before, strict=True):
            assert torch.equal(value, original)

    def test_copies_are_independent(self, plant, states, u):
        plant.start(*states)
        both = torch.cat(plant.advance(u, 0.01), -1)
        for k in range(2):
            plant.start(*(value[k : k + 1] for value in states))
            alone = torch.cat(plant.advance(u[k : k + 1], 0.01), -1)
            torch.testing.assert_close(both[k : k + 1], alone, rtol=1e-5, atol=1e-6)

    def test_an_input_that_is_not_finite_affects_its_copy_only(self, plant, states, u):
        broken = u.clone()
        broken[0, 0] = torch.nan
        plant.start(*states)
        q, _ = plant.advance(broken, 0.01)
        assert q[0].isnan().any()
        assert q[1].isfinite().all()

    def test_an_input_of_the_wrong_size_is_refused(self, plant, states, u):
        plant.start(*states)
        with pytest.raises(ValueError, match="u"):
            plant.advance(u[:, :-1], 0.01)
