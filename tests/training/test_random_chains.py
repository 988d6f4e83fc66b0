"""Chains of random bodies are found from generic ones, and their intervals hold the truth."""

import pytest

from tests.support.random_chains import fit_of_a_random_chain


@pytest.mark.slow
@pytest.mark.parametrize("seed", [12])
def test_a_random_chain_is_found_within_its_intervals(seed):
    outcome = fit_of_a_random_chain(seed)
    assert outcome.smallest_mass > 0
    assert outcome.smallest_slack > 0
    assert outcome.acceleration_error < 0.03
    assert outcome.determined >= 5
    assert outcome.deviation < 3
