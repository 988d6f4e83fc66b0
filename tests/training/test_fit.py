"""Training in one call does what it says, seen against a plain loop."""

import copy
import math
from functools import partial

import pytest
import torch

from pinn_dyn.data import DataSource, DynamicsData, Splits
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import (
    ConstantCholesky,
    ConstantInput,
    LagrangianNetwork,
    NetworkPotential,
    Positive,
)
from pinn_dyn.training import IncrementLoss, fit

EPOCHS, BATCHES, RATE = 2, 8, 0.02


class Swings(DataSource):
    """Three undamped oscillations of two uncoupled coordinates."""

    def load(self):
        t = torch.linspace(0, 4, 201, dtype=torch.float64)
        made = []
        for k in range(3):
            angle = t.unsqueeze(-1) * torch.tensor([1.0, 2.0]) + k
            q, v = torch.cos(angle), -torch.sin(angle) * torch.tensor([1.0, 2.0])
            made.append(Trajectory(q.double(), v.double(), Signal(t, torch.zeros_like(q).double())))
        return Splits(made[:1], made[1:2], made[2:])


@pytest.fixture
def data():
    return DynamicsData(
        Swings(), pairs=64, steps=1, stride=2, batch_size=16, batches_per_epoch=BATCHES, seed=0
    )


@pytest.fixture
def model(data):
    torch.manual_seed(0)
    return LagrangianNetwork(
        data.statistics,
        mass=ConstantCholesky,
        potential=partial(NetworkPotential, hidden=[8]),
        damping=partial(ConstantCholesky, positivity=Positive(floor=0.0)),
        input=ConstantInput,
    )


def test_a_rise_of_exactly_one_step_is_no_error(model):
    """5 % of 20 steps: torch's one-cycle schedule divides by zero there."""
    data = DynamicsData(
        Swings(), pairs=64, steps=1, stride=2, batch_size=16, batches_per_epoch=20, seed=0
    )
    before = copy.deepcopy(model.state_dict())
    (loss,) = fit(model, data, epochs=1, learning_rate=RATE, progress=False)
    assert math.isfinite(loss)
    assert any(not torch.equal(before[name], value) for name, value in model.state_dict().items())


def plain_loop(model, data):
    """AdamW, the one-cycle rate written out, gradients clipped."""
    loss_of = IncrementLoss(data.statistics, model)
    optimizer = torch.optim.AdamW(model.parameters(), weight_decay=1e-5)
    total, losses = EPOCHS * BATCHES, []
    rise = 0.05 * total - 1
    loader = data.train_dataloader()
    for epoch in range(EPOCHS):
        loader.sampler.set_epoch(epoch)
        values = []
        for k, batch in enumerate(loader):
            step = epoch * BATCHES + k
            # From RATE / 25 up to RATE, then down to RATE / 25,000, each along half a cosine.
            if step <= rise:
                start, end, part = RATE / 25, RATE, step / rise
            else:
                start, end, part = RATE, RATE / 25e3, (step - rise) / (total - 1 - rise)
            rate = end + (start - end) * (1 + math.cos(math.pi * part)) / 2
            optimizer.param_groups[0]["lr"] = rate
            loss = loss_of(model, loss_of.selected(batch, step / total))
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimizer.step()
            values.append(float(loss.detach()))
        losses.append(sum(values) / len(values))
    return losses


def test_it_is_the_plain_loop(model, data):
    other = copy.deepcopy(model)
    losses = fit(model, data, epochs=EPOCHS, learning_rate=RATE, progress=False)
    expected = plain_loop(other, data)
    assert losses == pytest.approx(expected, rel=1e-4)
    for (name, a), b in zip(model.named_parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5, msg=name)
    assert not model.training


def test_it_writes_nothing(model, data, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fit(model, data, epochs=1, learning_rate=RATE, progress=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("epochs", "rate"), [(0, 0.1), (1, 0.0), (1, float("nan"))])
def test_it_refuses_numbers_that_train_nothing(model, data, epochs, rate):
    with pytest.raises(ValueError, match="epochs is"):
        fit(model, data, epochs=epochs, learning_rate=rate)
