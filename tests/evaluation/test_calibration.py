"""Intervals of predictions on errors of which their share is known."""

import math

import pytest
import torch

from pinn_dyn.evaluation import Prediction, calibration
from pinn_dyn.evaluation.calibration import (
    half_widths,
    standardized_errors,
)


def prediction(seed, narrower=1.0, members=6, shape=(40, 60, 2)):
    """The truth is one more draw of what the members are drawn from, or of a wider one."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randn(members, *shape, generator=generator).double() / narrower
    q = torch.randn(*shape, generator=generator).double()
    for value in (drawn, q):
        value[..., 0, :] = 0  # all start where the robot does
    return Prediction(torch.arange(float(shape[1])), drawn.mean(0), q, drawn)


def test_members_of_one_kind_with_the_truth_hold_what_they_promise():
    found = calibration(prediction(0), None)
    assert found.share == pytest.approx(found.level, abs=0.02)
    assert found.corrected is None
    assert found.factor is None


def test_members_that_are_too_sure_are_corrected_on_validation():
    found = calibration(prediction(0, narrower=3), prediction(1, narrower=3))
    assert (found.share[:-1] < 0.75 * found.level[:-1]).all()
    assert found.corrected == pytest.approx(found.level, abs=0.02)
    assert 2 < found.factor < 3  # widths that vary less need not be three times as large
    assert found.within == found.share[list(found.level).index(0.95)]
    assert found.within_corrected == pytest.approx(0.95, abs=0.02)


def test_a_corrected_interval_contains_its_share_of_few_validation_errors():
    """95 % of 19 errors are 18.05, so the interval must contain all 19."""
    few = prediction(2, shape=(1, 20, 1))
    found = calibration(few, few)
    assert (found.corrected >= found.level).all()
    assert found.within_corrected == 1


def test_two_members_have_the_quantiles_of_cauchy():
    assert half_widths(2, 0.5) == pytest.approx(1.0)
    assert half_widths(2, 0.9) == pytest.approx(math.tan(0.45 * math.pi))


def test_a_rollout_that_broke_down_lies_in_no_interval():
    item = prediction(0)
    item.q_hat[:10, 30:] = math.nan
    errors = standardized_errors(item)
    assert errors[:10].isinf().all()
    assert errors[10:].isfinite().all()
    found = calibration(item, None)
    assert found.share[-1] == pytest.approx(0.75 * 0.99, abs=0.01)
    assert calibration(item, item).factor == math.inf


def test_members_that_agree_on_something_else_lie_in_no_interval():
    item = prediction(0)
    item.members[:, :20] = item.q_hat[:20]
    errors = standardized_errors(item)
    assert errors[:20].isinf().all()
    # Corrected intervals have a floor, which contains them, too.
    found = calibration(prediction(1), item)
    assert found.within_corrected > 0.93
