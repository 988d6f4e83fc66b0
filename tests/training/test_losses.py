"""The loss against a hand computation, which half of the state it sees, and its curriculum."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from pinn_dyn.data import draw_windows
from pinn_dyn.mechanics import ContinuousPredictor, Signal, Trajectory
from pinn_dyn.models import (
    AccelerationMLP,
    ConstantCholesky,
    ConstantInput,
    HamiltonianNetwork,
    LagrangianNetwork,
    NetworkPotential,
    NextStateMLP,
    Positive,
    Statistics,
)
from pinn_dyn.training import IncrementLoss, Penalized

STATISTICS = Statistics(
    q_mean=torch.zeros(1, dtype=torch.float64),
    q_std=torch.ones(1, dtype=torch.float64),
    q_low=torch.full((1,), -2.0, dtype=torch.float64),
    q_high=torch.full((1,), 2.0, dtype=torch.float64),
    v_std=torch.ones(1, dtype=torch.float64),
    p_std=torch.ones(1, dtype=torch.float64),
    u_mean=torch.zeros(1, dtype=torch.float64),
    u_std=torch.ones(1, dtype=torch.float64),
    # One row per step of a window, (q, v) or (q, p) in the columns.
    qv_increment_std=torch.tensor([[0.5, 2.0], [1.0, 4.0]], dtype=torch.float64),
    qp_increment_std=torch.tensor([[0.5, 8.0], [1.0, 16.0]], dtype=torch.float64),
    step=0.01,
)
ONE_STEP = replace(
    STATISTICS,
    qv_increment_std=STATISTICS.qv_increment_std[:1],
    qp_increment_std=STATISTICS.qp_increment_std[:1],
)
HEADS = dict(
    potential=partial(NetworkPotential, hidden=[4]),
    damping=partial(ConstantCholesky, positivity=Positive(floor=0.0)),
    input=ConstantInput,
)
MODELS = {
    "lnn": lambda: LagrangianNetwork(STATISTICS, ConstantCholesky, **HEADS),
    "hnn": lambda: HamiltonianNetwork(STATISTICS, ConstantCholesky, **HEADS),
    "acceleration": lambda: AccelerationMLP(STATISTICS, [4]),
    "next state": lambda: NextStateMLP(STATISTICS, [4]),
}
# Two windows of two steps; predictions err by (3, 4), (0, 8) and (-1, 0), (2, 2).
MEASURED = torch.tensor([[[1.0, 2.0], [3.0, 4.0]], [[5.0, 6.0], [7.0, 8.0]]])
PREDICTED = MEASURED + torch.tensor([[[3.0, 4.0], [0.0, 8.0]], [[-1.0, 0.0], [2.0, 2.0]]])
# q: (3/0.5)^2, 0, (1/0.5)^2, (2/1)^2; v: (4/2)^2, (8/4)^2, 0, (2/4)^2.
BOTH_HALVES = (36 + 0 + 4 + 4 + 4 + 4 + 0 + 0.25) / 8
BY_HAND = {
    "lnn": BOTH_HALVES,
    "acceleration": BOTH_HALVES,
    "next state": BOTH_HALVES,
    # q as above, with p: (4/8)^2, (8/16)^2, 0, (2/16)^2.
    "hnn": (36 + 0 + 4 + 4 + 0.25 + 0.25 + 0 + 1 / 64) / 8,
}
BY_HAND_ONE_STEP = {
    # v alone, where dq/dt = v holds by construction: (4/2)^2, 0.
    "lnn": (4 + 0) / 2,
    "acceleration": (4 + 0) / 2,
    # With q: (3/0.5)^2, (1/0.5)^2.
    "next state": (36 + 4 + 4 + 0) / 4,
    # q, and p: (4/8)^2, 0.
    "hnn": (36 + 4 + 0.25 + 0) / 4,
}


@pytest.mark.parametrize("kind", MODELS)
def test_the_loss_equals_a_hand_computation(kind):
    loss = IncrementLoss(STATISTICS, MODELS[kind]())
    assert float(loss.error(PREDICTED, MEASURED)) == pytest.approx(BY_HAND[kind], rel=1e-6)


@pytest.mark.parametrize("kind", MODELS)
def test_the_velocity_half_has_a_weight(kind):
    """Which leaves the scales of the data as they are."""
    loss = IncrementLoss(STATISTICS, MODELS[kind](), velocity_weight=0.25)
    q_half = (36 + 0 + 4 + 4) / 8
    expected = q_half + 0.25 * (BY_HAND[kind] - q_half)
    assert float(loss.error(PREDICTED, MEASURED)) == pytest.approx(expected, rel=1e-6)
    assert float(STATISTICS.qv_increment_std[0, 1]) == 2.0


@pytest.mark.parametrize("huber", [0.3, 5.0])
def test_the_pseudo_huber_loss_equals_a_hand_computation(huber):
    """r^2 is the mean over the two components of one window and one step."""
    loss = IncrementLoss(STATISTICS, MODELS["lnn"](), huber=huber)
    squares = torch.tensor([(36 + 4) / 2, (0 + 4) / 2, (4 + 0) / 2, (4 + 0.25) / 2])
    expected = (2 * huber**2 * (torch.sqrt(1 + squares / huber**2) - 1)).mean()
    assert float(loss.error(PREDICTED, MEASURED)) == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.parametrize("kind", MODELS)
def test_the_loss_of_one_step_equals_a_hand_computation(kind):
    loss = IncrementLoss(ONE_STEP, MODELS[kind]())
    found = float(loss.error(PREDICTED[:, :1], MEASURED[:, :1]))
    assert found == pytest.approx(BY_HAND_ONE_STEP[kind], rel=1e-6)


class Drift(ContinuousPredictor):
    """dq/dt = v, dv/dt = u, and a count of the evaluations."""

    def __init__(self):
        super().__init__(1, 1)
        self.calls = 0

    def state_derivative(self, x, u):
        self.calls += 1
        return torch.cat([x[..., 1:], u], -1)


@pytest.fixture
def windows():
    generator = torch.Generator().manual_seed(0)
    t = torch.arange(60, dtype=torch.float64) * 0.01
    q, v, u = torch.randn(3, 60, 1, generator=generator, dtype=torch.float64)
    return draw_windows([Trajectory(q, v, Signal(t, u))], count=8, steps=10, stride=2, seed=0)


@pytest.mark.parametrize(
    ("progress", "steps"),
    [(0.24, 1), (0.25, 2), (0.74, 5), (1, 10)],
)
def test_a_curriculum_rolls_out_and_compares_the_first_steps_alone(windows, progress, steps):
    model = Drift()
    loss = IncrementLoss(windows.statistics(), model, curriculum=[1, 2, 5, 10]).double()
    found = float(loss(model, loss.selected(windows, progress)))
    assert model.calls == 4 * steps
    # By hand: under a linear input the steps are those of the trapezoidal rule in v.
    u = windows.u
    dv = (0.01 * 0.5 * (u[:, 1:] + u[:, :-1])).cumsum(1)[:, 1::2]
    spread = windows.statistics().qv_increment_std
    residual = ((dv - windows.dv) / spread[:, 1:])[:, :steps]
    if steps == 1:  # q counts from two steps on
        assert found == pytest.approx(float(residual.square().mean()), rel=1e-6)
    else:
        with_q = model.predict(windows.start("qv"), windows.t, windows.input)
        dq = (with_q[:, 1:, :1] - windows.q[:, None] - windows.dq) / spread[:, :1]
        both = torch.cat([dq[:, :steps], residual], -1)
        assert found == pytest.approx(float(both.square().mean()), rel=1e-6)


class Watched(Drift):
    """Drift with a penalty that stores its arguments."""

    def penalty(self, *arguments):
        self.arguments = arguments
        return torch.tensor(3.0).double()


def test_a_penalty_is_added_at_the_first_step_of_a_window(windows):
    """A step has two samples: the mean of a linear input is that of the trapezoidal rule."""
    model = Watched()
    loss = IncrementLoss(windows.statistics(), model).double()
    assert float(Penalized(loss)(model, windows) - loss(model, windows)) == pytest.approx(3.0)
    u = windows.u[:, 0] / 4 + windows.u[:, 1] / 2 + windows.u[:, 2] / 4
    for found, expected in zip(
        model.arguments, (windows.q, windows.v, windows.dv[:, 0] / 0.02, u), strict=True
    ):
        torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("curriculum", [[1, 2], [0, 10], [5, 2, 10]])
def test_a_curriculum_has_to_increase_to_all_steps(windows, curriculum):
    with pytest.raises(ValueError, match=r"curriculum is .*to the 10 of the windows"):
        IncrementLoss(windows.statistics(), Drift(), curriculum=curriculum)
