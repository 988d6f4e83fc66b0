"""A training is AdamW with a one-cycle rate and clipped gradients, seen against a plain loop."""

import copy
import math
from functools import partial

import pytest
import torch
from torch.optim import AdamW

from pinn_dyn.data import DynamicsData, LightningData
from pinn_dyn.training import DynamicsLearner, IncrementLoss, one_cycle
from tests.support.training import MODELS, Oscillators, make_splits, make_trainer

EPOCHS, BATCHES, RATE = 2, 8, 0.02


@pytest.fixture(scope="module")
def source():
    return Oscillators(make_splits())


def data_of(source, batches):
    return DynamicsData(
        source, pairs=64, steps=1, stride=2, batch_size=16, batches_per_epoch=batches, seed=0
    )


def train(tmp_path, model, data, epochs):
    learner = DynamicsLearner(
        model,
        loss=IncrementLoss(data.statistics, model),
        optimizer=partial(AdamW, lr=RATE, weight_decay=1e-5, fused=True),
        scheduler=one_cycle,
        validator=lambda model, truth: {},
        config={},
        statistics=data.statistics,
        compile=False,
        gradient_clip_val=1.0,
    )
    make_trainer(tmp_path, max_epochs=epochs, limit_val_batches=0, enable_checkpointing=False).fit(
        learner, LightningData(data)
    )


def plain_loop(model, data):
    """AdamW, the one-cycle rate written out, gradients clipped."""
    loss_of = IncrementLoss(data.statistics, model)
    optimizer = AdamW(model.parameters(), weight_decay=1e-5)
    total = EPOCHS * BATCHES
    rise = 0.05 * total - 1
    loader = LightningData(data).train_dataloader()
    for epoch in range(EPOCHS):
        loader.sampler.set_epoch(epoch)
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


def test_it_is_the_plain_loop(tmp_path, source):
    data = data_of(source, BATCHES)
    torch.manual_seed(0)
    model = MODELS["lnn"](data.statistics)
    other = copy.deepcopy(model)
    train(tmp_path, model, data, EPOCHS)
    plain_loop(other, data)
    for (name, a), b in zip(model.named_parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5, msg=name)
