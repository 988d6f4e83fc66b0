import math

import pytest
import torch

from pinn_dyn.evaluation import (
    Prediction,
    predict_trajectories,
    rollout_metrics,
)
from pinn_dyn.evaluation.metrics import left_data, member_metrics, state_squared_error
from pinn_dyn.mechanics import ContinuousPredictor, Signal, Trajectory
from pinn_dyn.systems import SoftArm


class PointMass(ContinuousPredictor):
    """dv/dt = gain u: RK4 is exact for an input that is linear in between."""

    def __init__(self, gain=1.0, state="qv"):
        super().__init__(1, 1, state)
        self.gain = torch.nn.Parameter(torch.tensor(gain))

    def state_derivative(self, x, u):
        assert not self.training
        return torch.cat([x[..., 1:], self.gain * u], dim=-1)


def ramps(count=3, samples=13, sample_time=0.25):
    """Point masses under u = c t: q = q0 + v0 t + c t^3 / 6 for each."""
    t = sample_time * torch.arange(samples, dtype=torch.float64)
    c = torch.arange(1, count + 1, dtype=torch.float64)[:, None]
    q = 0.1 * c + 0.5 * t + c * t**3 / 6
    v = 0.5 + c * t**2 / 2
    u = c * t
    return Trajectory(q[..., None], v[..., None], Signal(t, u[..., None]))


def test_metrics_of_a_case_computed_by_hand():
    # Errors (0, 3, 0, 5) and (0, 1, 2, 1), from vectors whose norms are whole numbers.
    t = torch.tensor([2.0, 3.0, 4.0, 5.0])  # the horizon counts from the first time
    q = torch.tensor([[0.0, 1.0], [2.0, 0.0], [0.0, 3.0], [4.0, 1.0]]).repeat(2, 1, 1)
    off = torch.tensor(
        [
            [[0.0, 0.0], [0.0, -3.0], [0.0, 0.0], [3.0, 4.0]],
            [[0.0, 0.0], [1.0, 0.0], [0.0, 2.0], [-1.0, 0.0]],
        ]
    )
    found = rollout_metrics(q + off, q, t, thresholds={"low": 0.5, "mid": 1.5, "high": 9.0})
    assert found.to_dict() == pytest.approx(
        {
            "trajectories": 2,
            "diverged": 0,
            "horizon": 3.0,
            "error_mean": 12 / 8,
            "error_std": math.sqrt(40 / 8 - 1.5**2),
            "error_median": 1.0,
            "error_worst": 2.0,
            "worst_trajectory": 0,
            "squared_error_mean": 40 / 8,
            "squared_error_variance": (81 + 625 + 1 + 16 + 1) / 8 - 25,
            "valid_time_low": 1.0,
            "valid_time_mid": (1.0 + 2.0) / 2,
            "valid_time_high": 3.0,
        }
    )


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e9])
def test_a_diverged_trajectory_is_counted_and_left_out(bad):
    t = torch.linspace(0, 1, 5, dtype=torch.float64)
    q = torch.sin(t)[None, :, None].repeat(3, 1, 1)
    q_hat = q + torch.tensor([0.5, 0.5, 0.1])[:, None, None]
    q_hat[1, 3] = bad
    found = rollout_metrics(q_hat, q, t, thresholds={"wide": 0.6})
    assert found.diverged == 1
    assert (found.error_mean, found.error_median) == pytest.approx((0.3, 0.3))
    assert (found.error_worst, found.worst_trajectory) == (math.inf, 1)
    # The diverged one is valid until t = 0.75, the others up to the horizon.
    assert found.valid_time["wide"] == pytest.approx((1 + 0.75 + 1) / 3)


def test_all_diverged_gives_infinity_and_never_nan():
    t = torch.linspace(0, 1, 5)
    q = torch.rand(2, 5, 3, generator=torch.Generator().manual_seed(0))
    figures = rollout_metrics(q * math.nan, q, t, thresholds={"x": 0.1}).to_dict()
    assert not any(math.isnan(value) for value in figures.values())
    assert figures["diverged"] == 2
    for name in ("mean", "std", "median", "worst"):
        assert figures[f"error_{name}"] == math.inf
    assert figures["squared_error_mean"] == figures["squared_error_variance"] == math.inf
    assert figures["valid_time_x"] == 0


def test_leaving_the_data_is_by_more_than_their_width():
    """Training data from -1 to 1 and from 0 to 10: left beyond +-3, and below -10 or above 20."""
    t = torch.arange(5.0)
    q = torch.tensor([[-1.0, 0.0], [1.0, 10.0]])
    train = [Trajectory(q, q, Signal(t[:2], q))]
    inside = torch.tensor([[3.0, 0.0], [-3.0, 0.0], [0.0, 20.0], [0.0, -10.0], [0.0, 5.0]])
    far = inside.clone()
    far[3, 1] = -10.5
    broken = inside.clone()
    broken[2:, 0] = torch.nan
    found = {
        name: left_data(Prediction(t + 7, q_hat, q_hat), train)
        for name, q_hat in {
            "inside": torch.stack([inside, inside]),
            "far": torch.stack([inside, far]),
            "broken": torch.stack([broken, far]),
        }.items()
    }
    assert found["inside"] == {"left_data": 0, "left_data_after": math.inf}
    assert found["far"] == {"left_data": 1, "left_data_after": 3.0}
    assert found["broken"] == {"left_data": 2, "left_data_after": 2.0}


def test_the_squared_error_of_the_state_adds_that_of_the_velocity():
    """Point masses of the wrong gain: q errs by c t^3 / 6 and v by c t^2 / 2."""
    truth = ramps()
    t = truth.t
    c = torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64)
    square = (c * t**3 / 6) ** 2 + (c * t**2 / 2) ** 2
    found = state_squared_error(predict_trajectories(PointMass(gain=2.0), truth).every(2))
    assert found["state_squared_error_mean"] == pytest.approx(float(square[:, ::2].mean()))
    variance = float(square[:, ::2].var(correction=0))
    assert found["state_squared_error_variance"] == pytest.approx(variance)
    assert state_squared_error(predict_trajectories(PointMass(), truth, window=1.0)) == {}


def test_the_velocity_of_a_model_of_momenta_is_its_momentum_over_its_mass():
    """A soft arm rolled out in (q, p) against the same in (q, v)."""
    generator = torch.Generator().manual_seed(0)
    t = 0.001 * torch.arange(11, dtype=torch.float64)
    q = (0.5 * torch.rand(2, 1, 3, generator=generator, dtype=torch.float64)).expand(2, 11, 3)
    v = torch.rand(2, 1, 3, generator=generator, dtype=torch.float64).expand(2, 11, 3)
    arm, arm_of_momenta = SoftArm(), SoftArm()
    arm_of_momenta.state = "qp"
    arm_of_momenta.state_derivative = arm_of_momenta.momentum_derivative
    truth = Trajectory(q, v, Signal(t, torch.zeros(2, 11, 3).double()), momentum=arm.momentum)
    by_v, by_p = predict_trajectories(arm, truth), predict_trajectories(arm_of_momenta, truth)
    assert (by_v.v_hat[:, -1] - by_v.v[:, -1]).abs().max() > 0.01
    torch.testing.assert_close(by_p.v_hat, by_v.v_hat, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("step", "stride"), [(None, 1), (0.25, 1), (0.5, 2), (1.0, 4)])
def test_prediction_meets_the_closed_solution(step, stride):
    truth = ramps()
    prediction = predict_trajectories(PointMass(), truth, step=step)
    assert torch.equal(prediction.t, truth.t[::stride])
    assert torch.equal(prediction.q, truth.q[:, ::stride])
    torch.testing.assert_close(prediction.q_hat, prediction.q, rtol=0, atol=1e-12)


def test_the_model_of_the_caller_is_left_alone():
    model = PointMass(gain=1 / 3).train()  # and the copy asserts that it is not in training
    prediction = predict_trajectories(model, ramps())
    assert model.gain.dtype == torch.float32
    assert model.training
    assert prediction.q_hat.dtype == torch.float64
    assert not prediction.q_hat.requires_grad


def test_windows_are_set_back_to_the_true_state():
    truth = ramps()  # 12 intervals of 0.25 s
    model = PointMass(gain=2.0)
    prediction = predict_trajectories(model, truth, window=1.0)
    assert torch.equal(prediction.t, truth.t)
    # By hand: a window from t0 doubles the acceleration c t, so it errs by c times the
    # integral of (s - r) r over r in (t0, s), (s - t0)^2 (s + 2 t0) / 6.
    c = torch.arange(1, 4, dtype=torch.float64)[:, None]
    start = torch.tensor([0.0] * 5 + [1.0] * 4 + [2.0] * 4, dtype=torch.float64)
    expected = c * (truth.t - start) ** 2 * (truth.t + 2 * start) / 6
    torch.testing.assert_close(prediction.error(), expected)


# Ensembles.


def test_a_truth_that_is_like_a_member_is_calibrated_and_a_common_error_is_not():
    """Members and truth from one distribution; then the truth three times as far off."""
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(6, 40, 500, 2, generator=generator, dtype=torch.float64)
    t = torch.arange(500, dtype=torch.float64)
    members, q = drawn[:5], drawn[5]

    def figures(q):
        return member_metrics(Prediction(t, members.mean(0), q, members))

    found = figures(q)
    assert found["members"] == 5
    assert found["spread_over_error"] == pytest.approx(1, abs=0.02)
    # |x - y| of independent standard normal x, y in the plane has the mean sqrt(pi).
    assert found["member_error_mean"] == pytest.approx(math.sqrt(math.pi), rel=0.01)
    # sqrt(s^2) with s^2 the variance of 5 points in the plane, a gamma variable of shape 4.
    expected = math.sqrt(2 / 4) * math.gamma(4.5) / math.gamma(4)
    assert found["spread_mean"] == pytest.approx(expected, rel=0.01)
    # The error's mean square is 9 + 1/5 in place of 1 + 1/5 for each coordinate.
    expected = math.sqrt(1.2 / 9.2)
    assert figures(3 * q)["spread_over_error"] == pytest.approx(expected, rel=0.03)
