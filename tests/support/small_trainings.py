"""Small trainings."""

from functools import partial

import torch
from torch.optim import AdamW
from torch.optim.lr_scheduler import OneCycleLR

from pinn_dyn.data import DynamicsData
from pinn_dyn.training import IncrementLoss
from tests.models.builders import perturb
from tests.support.training import MODELS, Oscillators, make_splits, make_trainer


def make_data(steps=2):
    """Windows of coupled oscillators."""
    return DynamicsData(
        Oscillators(make_splits()),
        pairs=128,
        steps=steps,
        stride=2,
        batch_size=32,
        batches_per_epoch=8,
        seed=4,
    )


def make_models(kind, data, count):
    models = []
    for k in range(count):
        torch.manual_seed(k)
        models.append(perturb(MODELS[kind](data.statistics), seed=k, spread=0.2))
    return models


def learn(cls, model, single, data, optimizer=AdamW, compile=False):
    return cls(
        model,
        loss=IncrementLoss(data.statistics, single, curriculum=[1, 2]),
        optimizer=partial(optimizer, lr=0.01),
        scheduler=partial(OneCycleLR, max_lr=0.01),
        validator=lambda model, truth: {"error_mean": 1.0},
        config={},
        statistics=data.statistics,
        compile=compile,
        gradient_clip_val=0.3,
    )


def train(folder, learner, data, **options):
    trainer = make_trainer(folder, max_epochs=2, enable_checkpointing=False, **options)
    trainer.fit(learner, data)
    return trainer
