"""What is measured on validation trajectories during a training."""

import pytest
import torch

from pinn_dyn.evaluation import RolloutValidator
from pinn_dyn.mechanics import ContinuousPredictor, Signal, Trajectory

T = 0.25 * torch.arange(17, dtype=torch.float64)


class Drift(ContinuousPredictor):
    """dq/dt = v + rate: a rollout errs by the time since its start, times the rate."""

    def __init__(self, rate=1.0):
        super().__init__(1, 1)
        self.rate = torch.nn.Parameter(torch.tensor(rate))

    def state_derivative(self, x, u):
        return torch.cat([x[..., 1:] + self.rate, torch.zeros_like(u)], dim=-1)


def truth():
    """Two points at constant speed, 4 s in steps of 0.25 s."""
    v = torch.tensor([[[0.5]], [[-1.0]]], dtype=torch.float64).expand(2, 17, 1)
    return Trajectory(v * T[:, None], v, Signal(T, torch.zeros_like(v)))


def validator(window, horizon=3.0, step=0.5):
    return RolloutValidator(horizon=horizon, window=window, step=step, training_step=0.25)


@pytest.mark.parametrize(
    ("window", "errors", "text"),
    [
        (None, [0, 0.5, 1, 1.5, 2, 2.5, 3], "3 s open loop"),
        (1.0, [0, 0.5, 1, 0.5, 1, 0.5, 1], "3 s, reset every 1 s"),
    ],
)
def test_the_error_is_that_of_the_horizon_re_set_every_window(window, errors, text):
    figures = validator(window)(Drift(), truth())
    assert figures["error_mean"] == pytest.approx(sum(errors) / len(errors), rel=1e-12)
    assert figures["diverged"] == 0
    assert str(validator(window)) == text


@pytest.mark.parametrize("rate", [1.0, 0.01])
def test_the_windowed_error_is_in_units_of_standing_still(rate):
    """Speeds 0.5 and -1: standing still errs by their size times the time, 0.75 on the mean.

    The drift errs by the rate times the same times in each window, so the ratio is rate / 0.75
    whatever the windows are: 0.5 s (one step), 1 s (a quarter of the horizon) and 3 s.
    """
    figures = validator(None)(Drift(rate), truth())
    assert figures["error_windowed"] == pytest.approx(rate / 0.75, rel=1e-6)


def test_a_diverged_trajectory_counts_as_ten_times_standing_still():
    figures = validator(None)(Drift(float("nan")), truth())
    assert figures["error_windowed"] == 10.0
    assert figures["error_mean"] == float("inf")


def test_quarters_of_each_trajectory_have_errors_of_their_own():
    """The errors at 0, 0.5, ..., 3 s are the times since the last reset of each window."""
    since = {3.0: [0, 0.5, 1, 1.5, 2, 2.5, 3], 1.0: [0, 0.5, 1, 0.5, 1, 0.5, 1]}
    since[0.5] = [0, *6 * [0.5]]
    times = torch.tensor(list(since.values()))
    quarters = torch.stack([times[:, k : k + 2].mean(1) for k in (0, 2, 4, 6)], dim=1)
    expected = (quarters / (0.75 * times.mean(1, keepdim=True))).mean(0)
    errors = validator(None).part_errors(Drift(), truth())
    torch.testing.assert_close(errors, expected.double().repeat(2), rtol=1e-6, atol=0)


def still(offset=0.0):
    q = torch.full((2, 17, 1), offset, dtype=torch.float64)
    return Trajectory(q, 0 * q, Signal(T, 0 * q))


def test_epochs_are_ranked_where_the_validation_rests():
    """Both drifts are far more than standing still, and little of the motion of the training."""
    item = validator(None)
    training = [Trajectory(x, x, Signal(T, 0 * x)) for x in truth().q]
    item.check(still(), training)
    errors = [item(Drift(rate), still())["error_windowed"] for rate in (0.02, 0.01, 0.5)]
    assert 0 < errors[1] < errors[0] < errors[2] < 1


def test_large_errors_are_ranked_below_those_of_diverged_rollouts():
    errors = [validator(None)(Drift(x), truth())["error_windowed"] for x in (20.0, 100.0)]
    assert 9 < errors[0] < errors[1] < 10
