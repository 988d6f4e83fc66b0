"""The LightningModule: a training lowers the loss, and stops at one that is not a number."""

import contextlib
import itertools
from functools import partial

import numpy as np
import pytest
import pytorch_optimizer as library
import torch
from lightning.pytorch.callbacks import Callback, EMAWeightAveraging, ModelCheckpoint
from torch.nn.utils import clip_grad_norm_
from torch.optim import AdamW
from torch.optim.lr_scheduler import OneCycleLR

from pinn_dyn.data import DynamicsData, LightningData
from pinn_dyn.models import AccelerationMLP
from pinn_dyn.training import (
    SOAP,
    DynamicsLearner,
    IncrementLoss,
    MidpointLoss,
    NonFiniteLossError,
)
from pinn_dyn.training.gradients import Compiled
from pinn_dyn.training.parameter_vector import clipped
from tests.support.training import MODELS, Oscillators, make_splits, make_trainer


@pytest.fixture(scope="module")
def splits():
    return make_splits()


@pytest.fixture
def data(splits):
    return DynamicsData(
        Oscillators(splits),
        pairs=128,
        steps=1,
        stride=2,
        batch_size=32,
        batches_per_epoch=30,
        seed=0,
    )


def make_learner(
    model,
    data,
    validator=lambda model, truth: {"error_mean": 1.0},
    lr=0.01,
    optimizer=AdamW,
    loss=IncrementLoss,
    compile=False,
):
    return DynamicsLearner(
        model,
        loss=loss(data.statistics, model),
        optimizer=partial(optimizer, lr=lr),
        scheduler=partial(OneCycleLR, max_lr=lr),
        validator=validator,
        config={"seed": 0},
        statistics=data.statistics,
        compile=compile,
    )


def loss_of(learner, data):
    windows = data.windows.to(torch.device("cpu"), torch.float32)
    with torch.no_grad():
        return float(learner.loss(learner.model, windows))


@pytest.mark.parametrize(
    ("kind", "optimizer"),
    [*((kind, AdamW) for kind in MODELS), ("lnn", SOAP), ("lnn", library.SOAP)],
)
def test_a_short_training_lowers_the_loss(tmp_path, data, kind, optimizer):
    """Of every model, and by optimizers that take each parameter, not all of them as one vector."""
    torch.manual_seed(0)
    learner = make_learner(MODELS[kind](data.statistics), data, optimizer=optimizer)
    before = loss_of(learner, data)
    make_trainer(tmp_path, max_epochs=3, enable_checkpointing=False).fit(
        learner, LightningData(data)
    )
    assert loss_of(learner, data) < 0.5 * before


@pytest.mark.parametrize("cut", [False, True])
def test_the_logged_loss_is_that_of_the_batches(tmp_path, data, cut):
    """With the learning rate at zero it is the mean over batches of a fixed model's loss.

    Those of an epoch that was cut short before do not count.
    """
    torch.manual_seed(0)
    learner = make_learner(AccelerationMLP(data.statistics, [8]), data, lr=0.0)
    if cut:
        options = {"max_epochs": 1, "max_steps": 5, "enable_checkpointing": False}
        make_trainer(tmp_path, **options).fit(learner, LightningData(data))
    trainer = make_trainer(tmp_path, max_epochs=1, enable_checkpointing=False)
    trainer.fit(learner, LightningData(data))
    loader = LightningData(data).train_dataloader()
    expected = []
    for batch in loader:
        with torch.no_grad():
            expected.append(float(learner.loss(learner.model, batch)))
    assert len(expected) == 30
    assert float(trainer.callback_metrics["train/loss"]) == pytest.approx(
        np.mean(expected), rel=1e-5
    )


def test_a_gradient_is_clipped_by_its_norm():
    generator = torch.Generator().manual_seed(0)
    for factor in (0.01, 1.0, 100.0):
        gradients = [factor * torch.randn(x, generator=generator) for x in ((4, 5), (7,), ())]
        parameters = [torch.nn.Parameter(torch.zeros_like(x)) for x in gradients]
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient.clone()
        clip_grad_norm_(parameters, 0.5)
        found = clipped(torch.cat([x.flatten() for x in gradients]), 0.5)
        expected = torch.cat([x.grad.flatten() for x in parameters])
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)


class Breaks(AccelerationMLP):
    """Its predictions are not numbers any more after some training steps."""

    calls = 0
    good = 70

    def state_derivative(self, x, u):
        rate = super().state_derivative(x, u)
        if torch.is_grad_enabled():
            self.calls += 1
        # Four evaluations of the derivative in a step.
        return rate if self.calls <= 4 * self.good else rate * float("nan")


def test_a_loss_that_is_not_a_number_stops_the_training_and_keeps_the_checkpoints(tmp_path, data):
    torch.manual_seed(0)
    learner = make_learner(Breaks(data.statistics, [8]), data)
    checkpoint = ModelCheckpoint(
        dirpath=tmp_path / "checkpoints", filename="best", monitor="val/error_mean", save_last=True
    )
    trainer = make_trainer(tmp_path, max_epochs=4, callbacks=[checkpoint])
    with pytest.raises(NonFiniteLossError, match=r"became nan at step 70 \(epoch 2\)"):
        trainer.fit(learner, LightningData(data))
    for name in ("best", "last"):
        saved = torch.load(tmp_path / "checkpoints" / f"{name}.ckpt", weights_only=True)
        assert saved["global_step"] in (30, 60)
        fresh = make_learner(AccelerationMLP(data.statistics, [8]), data)
        fresh.load_state_dict(saved["state_dict"])
        assert np.isfinite(loss_of(fresh, data))
        assert all(torch.isfinite(value).all() for value in saved["state_dict"].values())


class Ends(Callback):
    """Notes where each training step of Lightning ends."""

    def __init__(self):
        self.steps, self.batches, self.progress = [], [], []

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        self.steps.append(trainer.global_step)
        self.batches.append(batch_idx + 1)


def trained(tmp_path, data, monkeypatch, seconds, **options):
    monkeypatch.setattr("pinn_dyn.training.learner.BLOCK_SECONDS", seconds)
    torch.manual_seed(0)
    learner = make_learner(AccelerationMLP(data.statistics, [8]), data)
    ends, selected = Ends(), learner.loss.selected

    def noted(windows, progress):
        ends.progress.append(progress)
        return selected(windows, progress)

    monkeypatch.setattr(learner.loss, "selected", noted)
    options = {"log_every_n_steps": 20, "enable_checkpointing": False, **options}
    trainer = make_trainer(tmp_path, max_epochs=2, callbacks=[ends], **options)
    trainer.fit(learner, LightningData(data))
    return [p.detach().clone() for p in learner.model.parameters()], ends, trainer


def test_many_steps_in_one_are_the_same_training(tmp_path, data, monkeypatch):
    """They end where a log is due or an epoch ends, or each by itself when time is short."""
    together, ends, trainer = trained(tmp_path, data, monkeypatch, 100.0)
    # The first step tells how many fit into the time.
    assert ends.steps == [1, 19, 20, 30, 39, 40, 59, 60]
    assert ends.batches == [1, 19, 20, 30, 9, 10, 29, 30]
    alone, each, other = trained(tmp_path, data, monkeypatch, 0.0)
    assert each.steps == list(range(1, 61))
    assert ends.progress == each.progress == [step / 60 for step in range(60)]
    assert trainer.global_step == other.global_step == 60
    assert trainer.callback_metrics["train/loss"] == other.callback_metrics["train/loss"]
    for one, two in zip(together, alone, strict=True):
        assert torch.equal(one, two)


def taught(tmp_path, data, compile, interrupted=None):
    """A learner, and where its schedule and optimizer are after a training, or an interrupt.

    The schedule moves the rate and the momentum.
    """
    torch.manual_seed(0)
    model = AccelerationMLP(data.statistics, [8])
    learner = make_learner(model, data, loss=MidpointLoss, compile=compile)
    prepared = learner._prepared_steps

    def stopped(*arguments):
        for step, take in enumerate(prepared(*arguments), learner.global_step):
            yield take if step != interrupted else partial(interrupt, learner)

    learner._prepared_steps = stopped
    trainer = make_trainer(tmp_path, max_epochs=2, enable_checkpointing=False)
    with contextlib.suppress(SystemExit, KeyboardInterrupt):
        trainer.fit(learner, LightningData(data))
    (group,) = learner.optimizers(use_pl_optimizer=False).param_groups
    return learner, learner.lr_schedulers().last_epoch, group["lr"], group["betas"][0]


def interrupt(learner):
    raise KeyboardInterrupt


def test_a_program_takes_each_step_with_its_rate_and_momentum(tmp_path, data, traced, monkeypatch):
    """Mix batches for the program and batches for the optimizer."""
    monkeypatch.setattr("pinn_dyn.training.learner.BLOCK_SECONDS", 100.0)
    step, calls = Compiled.step, itertools.count()

    def sometimes(*arguments):
        return step(*arguments) if next(calls) % 15 < 12 else None

    monkeypatch.setattr(Compiled, "step", sometimes)
    (program, *ours), (eager, *theirs) = (taught(tmp_path, data, x) for x in (True, False))
    assert ours == theirs
    assert next(calls) > 20
    for one, two in zip(program.model.parameters(), eager.model.parameters(), strict=True):
        torch.testing.assert_close(one, two, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("compile", [True, False])
def test_the_schedule_of_interrupted_steps_is_that_of_the_steps_done(
    tmp_path, data, traced, monkeypatch, compile
):
    monkeypatch.setattr("pinn_dyn.training.learner.BLOCK_SECONDS", 100.0)
    learner, *state = taught(tmp_path, data, compile, interrupted=41)
    optimizer = AdamW([torch.nn.Parameter(torch.ones(1))])
    schedule = OneCycleLR(optimizer, max_lr=0.01, total_steps=60)
    for _ in range(41):
        optimizer.step()
        schedule.step()
    (group,) = optimizer.param_groups
    assert (learner.global_step, *state) == (41, 41, group["lr"], group["betas"][0])


def test_steps_end_where_the_trainer_validates_or_stops(tmp_path, data, monkeypatch):
    _, ends, _ = trained(tmp_path, data, monkeypatch, 100.0, val_check_interval=7)
    assert [k for k in ends.batches if k % 7 == 0] == 2 * [7, 14, 21, 28]  # in each epoch
    over_epochs = {"val_check_interval": 7, "check_val_every_n_epoch": None}
    _, ends, _ = trained(tmp_path, data, monkeypatch, 100.0, **over_epochs)
    assert [k for k in ends.steps if k % 7 == 0] == list(range(7, 60, 7))
    _, ends, _ = trained(tmp_path, data, monkeypatch, 100.0, max_steps=33)
    assert ends.steps[-1] == 33


def test_weights_are_averaged_over_steps_not_over_their_blocks(tmp_path, data):
    learner = make_learner(AccelerationMLP(data.statistics, [8]), data)
    weights = [p.detach().clone() for p in learner.model.parameters()]
    averaged = [p.clone() for p in weights]
    average = EMAWeightAveraging(decay=0.9)
    trainer = make_trainer(
        tmp_path, max_epochs=1, callbacks=[average, Follows(averaged)], enable_checkpointing=False
    )
    trainer.fit(learner, LightningData(data))
    assert trainer.global_step == 30
    for one, two in zip(learner.model.parameters(), averaged, strict=True):
        torch.testing.assert_close(one.detach(), two)


class Follows(Callback):
    """An average of its own: the first step is taken over, the others count a tenth."""

    def __init__(self, averaged):
        self.averaged = averaged

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        share = 1.0 if trainer.global_step == 1 else 0.1
        for mean, now in zip(self.averaged, pl_module.model.parameters(), strict=True):
            mean.lerp_(now.detach(), share)
