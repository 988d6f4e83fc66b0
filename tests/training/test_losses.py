"""The loss against a hand computation, and which half of the state it sees."""

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
BY_HAND = {
    # v alone: (4/2)^2, (8/4)^2, 0, (2/4)^2 over 4 entries.
    "lnn": (4 + 4 + 0 + 0.25) / 4,
    "acceleration": (4 + 4 + 0 + 0.25) / 4,
    # q: (3/0.5)^2, 0, (1/0.5)^2, 2^2; with v as above.
    "next state": (36 + 0 + 4 + 4 + 4 + 4 + 0 + 0.25) / 8,
    # q as above, with p: (4/8)^2, (8/16)^2, 0, (2/16)^2.
    "hnn": (36 + 0 + 4 + 4 + 0.25 + 0.25 + 0 + 1 / 64) / 8,
}


@pytest.mark.parametrize("kind", MODELS)
def test_the_loss_equals_a_hand_computation(kind):
    loss = IncrementLoss(STATISTICS, MODELS[kind]())
    assert float(loss(PREDICTED, MEASURED)) == pytest.approx(BY_HAND[kind], rel=1e-6)


@pytest.mark.parametrize(
    ("kind", "sees"),
    [("lnn", False), ("acceleration", False), ("hnn", True), ("next state", True)],
)
def test_the_configuration_half_counts_where_it_does_not_hold_by_construction(kind, sees):
    loss = IncrementLoss(STATISTICS, MODELS[kind]())
    moved = MEASURED.clone()
    moved[..., 0] += 1
    assert (float(loss(moved, MEASURED)) > 0) == sees
    moved = MEASURED.clone()
    moved[..., 1] += 1
    assert float(loss(moved, MEASURED)) > 0


@pytest.mark.parametrize("kind", MODELS)
def test_exact_predictions_have_no_loss(kind):
    assert float(IncrementLoss(STATISTICS, MODELS[kind]())(MEASURED, MEASURED)) == 0


def test_the_loss_has_nothing_to_learn_or_to_save():
    loss = IncrementLoss(STATISTICS, MODELS["lnn"]())
    assert not list(loss.parameters())
    assert not loss.state_dict()
