"""The midpoint rule as a loss: exact motions, its order, and what it refuses."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.polynomial import Polynomial

from pinn_dyn.data import draw_windows
from pinn_dyn.mechanics import ContinuousPredictor, Signal, Trajectory
from pinn_dyn.training import MidpointLoss
from pinn_dyn.training.losses import midpoint
from tests.models.builders import make_model
from tests.support.windows import make_windows, one_step


class Force(ContinuousPredictor):
    """dq/dt = v, dv/dt = -k q + u; or, with momenta, the same for a unit mass."""

    def __init__(self, stiffness, state="qv"):
        super().__init__(1, 1, state)
        self.stiffness = stiffness

    def state_derivative(self, x, u):
        q, v = x.chunk(2, -1)
        return torch.cat([v, u - self.stiffness * q], -1)


def relative_error(windows, model):
    """Root mean square of dv^ - dv over that of dv."""
    loss = MidpointLoss(windows.statistics(), model).double()
    with torch.no_grad():
        value = float(loss(model, windows))
    return math.sqrt(value) * float(loss.scale[-1] / windows.dv.square().mean().sqrt())


def test_the_middle_is_that_of_a_cubic():
    q = Polynomial([0.3, -1.2, 2.0, 5.0])
    v, h = q.deriv(), 0.4
    start, end = ([float(q(t)), float(v(t))] for t in (0.1, 0.1 + h))
    x0 = torch.tensor([start], dtype=torch.float64)
    dx = torch.tensor([end], dtype=torch.float64) - x0
    found = midpoint(torch.tensor(h), x0, dx)[0].tolist()
    assert found == pytest.approx([q(0.3), v(0.3)], rel=1e-7)


@pytest.mark.parametrize(
    ("interpolation", "expected"),
    [("linear", (0.5 * 1 + 3 + 0.5 * 2) / 2), ("hold", (1 + 3) / 2)],
)
def test_the_input_is_its_mean_over_the_step(interpolation, expected):
    """So a force that does not depend on the state is integrated exactly."""
    windows = make_windows(5, interpolation=interpolation)
    h = float(windows.t[1])
    u = torch.tensor([[1.0], [3.0], [2.0]], dtype=torch.float64).expand(5, 3, 1)
    windows = replace(
        windows, input=windows.input.with_samples(u), dv=torch.full_like(windows.dv, expected * h)
    )
    assert relative_error(windows, Force(0.0)) < 1e-7
    wrong = replace(windows, dv=1.1 * windows.dv)
    assert relative_error(wrong, Force(0.0)) == pytest.approx(0.1 / 1.1, rel=1e-5)


@pytest.mark.parametrize(("state", "constant"), [("qv", 24), ("qp", 12)])
def test_on_an_oscillation_the_error_is_that_of_the_docstring(state, constant):
    """(r h)^2/24 for r rad/s, from the exact motion q = cos(r t)."""
    rate, errors = 7.0, []
    for h in (0.02, 0.01):
        t = torch.arange(0, 40, h, dtype=torch.float64)[:, None]
        q, v = torch.cos(rate * t), -rate * torch.sin(rate * t)
        motion = Trajectory(q, v, Signal(t[:, 0], torch.zeros_like(q)), momentum=lambda q, v: v)
        windows = draw_windows([motion], count=len(t) - 1, steps=1, stride=1, seed=0)
        model = Force(rate**2, state)
        loss = MidpointLoss(windows.statistics(), model).double()
        x0, dx = windows.start(state), windows.increments(state)[:, 0]
        middle = midpoint(torch.tensor(h), x0, dx) if constant == 24 else x0 + dx / 2
        residual = h * model.state_derivative(middle, windows.u[:, 0]) - dx
        errors.append(float(residual[:, 1].norm() / dx[:, 1].norm()))
        assert errors[-1] == pytest.approx((rate * h) ** 2 / constant, rel=0.01)
        by_hand = (residual / windows.statistics().qv_increment_std[0]).square()
        by_hand = by_hand[:, 1].mean() if constant == 24 else by_hand.mean()
        assert float(loss(model, windows)) == pytest.approx(float(by_hand), rel=1e-4)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.02)


def test_it_refuses_a_model_without_a_derivative_and_windows_of_several_steps():
    with pytest.raises(TypeError, match=r"NextStateMLP, expected .*use loss=increment"):
        MidpointLoss(one_step(size=2), make_model("next_state"))
    two = replace(one_step(size=2), qv_increment_std=torch.ones(2, 4))
    with pytest.raises(ValueError, match=r"have 2 steps, expected one: set data.steps=1"):
        MidpointLoss(two, make_model("lnn"))
