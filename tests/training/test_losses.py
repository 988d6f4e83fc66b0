"""The loss against a hand computation, and which half of the state it sees."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from pinn_dyn.models import (
    AccelerationMLP,
    ConstantCholesky,
    ConstantInput,
    HamiltonianNetwork,
    LagrangianNetwork,
    NetworkPotential,
    NextStateMLP,
    Statistics,
)
from pinn_dyn.training import IncrementLoss

STATISTICS = Statistics(
    q_mean=torch.zeros(1, dtype=torch.float64),
    q_std=torch.ones(1, dtype=torch.float64),
    v_std=torch.ones(1, dtype=torch.float64),
    p_std=torch.ones(1, dtype=torch.float64),
    u_mean=torch.zeros(1, dtype=torch.float64),
    u_std=torch.ones(1, dtype=torch.float64),
    # One row per step of a window, (q, v) or (q, p) in the columns.
    velocity_increment_std=torch.tensor([[0.5, 2.0], [1.0, 4.0]], dtype=torch.float64),
    momentum_increment_std=torch.tensor([[0.5, 8.0], [1.0, 16.0]], dtype=torch.float64),
    step=0.01,
)
ONE_STEP = replace(
    STATISTICS,
    velocity_increment_std=STATISTICS.velocity_increment_std[:1],
    momentum_increment_std=STATISTICS.momentum_increment_std[:1],
)
HEADS = dict(
    potential=partial(NetworkPotential, hidden=[4]),
    damping=partial(ConstantCholesky, epsilon=0.0),
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
    assert float(loss(PREDICTED, MEASURED)) == pytest.approx(BY_HAND[kind], rel=1e-6)


@pytest.mark.parametrize("kind", MODELS)
def test_the_loss_of_one_step_equals_a_hand_computation(kind):
    loss = IncrementLoss(ONE_STEP, MODELS[kind]())
    found = float(loss(PREDICTED[:, :1], MEASURED[:, :1]))
    assert found == pytest.approx(BY_HAND_ONE_STEP[kind], rel=1e-6)


@pytest.mark.parametrize(
    ("kind", "statistics", "sees"),
    [
        ("lnn", ONE_STEP, False),
        ("acceleration", ONE_STEP, False),
        ("hnn", ONE_STEP, True),
        ("next state", ONE_STEP, True),
        ("lnn", STATISTICS, True),
        ("acceleration", STATISTICS, True),
        ("hnn", STATISTICS, True),
        ("next state", STATISTICS, True),
    ],
)
def test_the_configuration_half_counts_but_in_one_step_where_it_holds_by_construction(
    kind, statistics, sees
):
    loss = IncrementLoss(statistics, MODELS[kind]())
    measured = MEASURED[:, : len(statistics.velocity_increment_std)]
    moved = measured.clone()
    moved[..., 0] += 1
    assert (float(loss(moved, measured)) > 0) == sees
    moved = measured.clone()
    moved[..., 1] += 1
    assert float(loss(moved, measured)) > 0


@pytest.mark.parametrize("kind", MODELS)
def test_exact_predictions_have_no_loss(kind):
    assert float(IncrementLoss(STATISTICS, MODELS[kind]())(MEASURED, MEASURED)) == 0


def test_the_loss_has_nothing_to_learn_or_to_save():
    loss = IncrementLoss(STATISTICS, MODELS["lnn"]())
    assert not list(loss.parameters())
    assert not loss.state_dict()
