"""The Stumpff functions against closed forms, exact series and finite differences."""

import math
from fractions import Fraction

import pytest
import torch

from pinn_dyn.systems.segment_frames import first_slopes, second_slopes, stumpff
from pinn_dyn.testing import slope

FULL_CIRCLE = 4 * math.pi**2


def exact(k, x):
    """c_k(x) by its series in rational arithmetic, without rounding."""
    x = Fraction(x)
    terms = ((-x) ** j / math.factorial(k + 2 * j) for j in range(60))
    return float(sum(terms))


@pytest.mark.parametrize("x", [0.0, 1e-16, 1e-8, 1e-4, 0.01, 1.0, 10.0, FULL_CIRCLE])
def test_values_match_the_exact_series(x):
    values = stumpff(torch.tensor(x, dtype=torch.float64))
    for k, value in enumerate(values):
        assert float(value) == pytest.approx(exact(k, x), rel=1e-12, abs=4e-15), k


@pytest.mark.parametrize("x", [0.0, 1e-6, 0.5, 4.0, 30.0])
def test_slopes_match_finite_differences(x):
    x = torch.tensor(x, dtype=torch.float64)
    first = first_slopes(stumpff(x))
    for k, value in zip((1, 2, 3), first, strict=True):
        expected = slope(lambda e, k=k: stumpff(x + e)[k], 1e-2)
        torch.testing.assert_close(value, expected, rtol=0, atol=1e-11)
    for k, value in enumerate(second_slopes(stumpff(x))):
        expected = slope(lambda e, k=k: first_slopes(stumpff(x + e))[k], 1e-2)
        torch.testing.assert_close(value, expected, rtol=0, atol=1e-11)
