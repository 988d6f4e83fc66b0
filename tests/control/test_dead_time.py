"""Laws that compensate dead time, on a plant whose inputs act late."""

import numpy as np
import pytest
import torch

from pinn_dyn.control import (
    Actuator,
    DisturbanceObserver,
    Pipeline,
    PredictiveControl,
    Sines,
    Tracking,
    close_loop,
)
from pinn_dyn.control.contracts import Plant
from pinn_dyn.control.pipeline import DeadTime
from tests.support.closed_loops import PD
from tests.support.linear import Pendulums

RATE, PIECES = 100.0, 10
MASS = np.array([[0.5, 0.1], [0.1, 0.2]])
GRAVITY, DAMPING, INPUTS = (
    np.diag([6.0, 2.0]),
    np.diag([0.2, 0.1]),
    np.array([[1.0, 0], [0.2, 0.9]]),
)
REFERENCE = Sines([0.2, -0.1], [0.8, 0.6], [0.9, 1.3], rise_time=0.5)


class LatePendulums(Plant):
    """Their equation of motion in NumPy, and a queue of held inputs that each arrive late."""

    num_coordinates = num_inputs = 2

    def __init__(self, delays):
        self.lags = [round(d * RATE * PIECES) for d in delays]

    def start(self, q0, v0):
        self.x = torch.cat([q0, v0], -1).numpy()
        self.queue = [np.zeros((len(q0), 2))] * (max(self.lags) + 1)

    def advance(self, u, duration):
        h = duration / PIECES
        for _ in range(PIECES):
            self.queue = [*self.queue[1:], u.numpy()]
            force = np.stack([self.queue[-1 - n][:, i] for i, n in enumerate(self.lags)], -1)
            k1 = self.slope(self.x, force)
            k2 = self.slope(self.x + h / 2 * k1, force)
            self.x = self.x + h * self.slope(self.x + h / 2 * k2, force)
        return tuple(torch.from_numpy(x.copy()) for x in np.split(self.x, 2, -1))

    @staticmethod
    def slope(x, u):
        q, v = np.split(x, 2, -1)
        force = u @ INPUTS.T - v @ DAMPING.T - np.sin(q) @ GRAVITY
        return np.hstack([v, force @ np.linalg.inv(MASS)])


@pytest.fixture(scope="module")
def model():
    return Pendulums(MASS, GRAVITY, DAMPING, INPUTS).requires_grad_(False)


def closed(law, delays=(0.0, 0.0), plant=None, **settings):
    start = REFERENCE(0.0)
    plant = plant or LatePendulums(delays)
    record = close_loop(
        plant, law, REFERENCE, start.q[None], start.v[None], duration=1.0, rate=RATE, **settings
    )
    assert record.stopped == [None]
    return record


def tracking_error(*arguments):
    record = closed(*arguments)
    return float((record.q - record.reference.q).square().mean().sqrt())


def tracking(model):
    return Tracking(model, 25.0, 4.0)


def observed(model):
    return DisturbanceObserver(tracking(model), 20.0)


def predictive(model):
    return PredictiveControl(model, 0.2, 0.02, position_weight=100.0, input_weight=1e-4)


@pytest.mark.parametrize(
    ("make", "delays"),
    [
        (tracking, (0.03, 0.013)),
        (observed, (0.03, 0.013)),
        (predictive, (0.03, 0.013)),
    ],
)
def test_dead_time_costs_less_than_a_third_of_the_tracking_error(model, make, delays):
    if make is predictive:
        pytest.importorskip("casadi")
    expected = tracking_error(make(model))
    law = Pipeline(make(model), 1 / RATE, dead_time=delays)
    assert tracking_error(law, delays) < 1.3 * expected
    if make is tracking:
        assert tracking_error(make(model), delays) > 2 * expected


def test_the_loop_delays_by_parts_of_a_period(model):
    limits = dict(low=-1.0, high=3.0, rate=100.0)
    late = closed(tracking(model), (0.016, 0.016), actuator=Actuator(**limits))
    loop = closed(tracking(model), dead_time=0.016, actuator=Actuator(**limits))
    np.testing.assert_allclose(loop.q, late.q, atol=1e-5)
    assert np.abs(loop.q - closed(tracking(model)).q).max() > 1e-3


def test_the_prediction_takes_the_inputs_that_act_within_the_dead_time(model):
    """By many small steps: 2.6 and 1 periods, of which the older input acts for 0.6 periods."""
    late = DeadTime(model, [0.026, 0.01], 1 / RATE)
    assert (late.ahead, late.size) == (0.026, 3)
    q, v = torch.tensor([0.3, -0.2]).double(), torch.tensor([1.0, 0.5]).double()
    past = torch.tensor([[3.0, -1.0], [-2.0, 2.0], [1.0, 4.0]]).double()
    x = np.concatenate([q, v])[None]
    for u, periods in zip(past.numpy(), (0.6, 1.0, 1.0), strict=True):
        h = periods / RATE / 1000
        for _ in range(1000):
            x = x + h * LatePendulums.slope(x, u)
    found = torch.cat(late.predict(q, v, past)).numpy()
    np.testing.assert_allclose(found, x[0], atol=2e-4)
    # The second input waits 1.6 periods longer than it must: between the last and the one before.
    new = torch.cat([past, torch.tensor([[7.0, -3.0]]).double()])
    assert late.held_back(new).tolist() == pytest.approx([7.0, 0.6 * 2.0 + 0.4 * 4.0])


def test_a_law_without_a_model_cannot_compensate_a_dead_time():
    with pytest.raises(ValueError, match="PD has no model that predicts over the dead time"):
        Pipeline(PD(), 0.01, dead_time=0.02)
