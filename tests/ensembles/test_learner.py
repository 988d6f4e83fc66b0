"""Members trained at once end with the weights that trainings of their own give."""

import pytest
import torch
from torch.optim import LBFGS
from torch.optim.lr_scheduler import ConstantLR

from pinn_dyn.data import LightningData
from pinn_dyn.data.windows import BatchSampler, WindowLoader
from pinn_dyn.ensembles import Ensemble, EnsembleLearner
from pinn_dyn.training import DynamicsLearner, NonFiniteLossError
from tests.support.ensembles import learn, make_data, make_models, train
from tests.support.training import make_trainer

KINDS = ("lnn", "hnn", "acceleration", "next state")


def trained_alone(folder, kind, data, index):
    """The training of one seed: its own weights, its own order of the same windows."""
    model = make_models(kind, data, 2)[index]
    learner = learn(DynamicsLearner, model, model, data)
    order = BatchSampler(128, batch_size=32, batches=8, seed=4 + index)
    windows = data.windows.to(torch.device("cpu"), torch.float32)
    learner.train_dataloader = lambda: WindowLoader(windows, order)
    trainer = make_trainer(folder, max_epochs=2, enable_checkpointing=False)
    trainer.fit(learner)
    return model, float(trainer.callback_metrics["train/loss"])


@pytest.mark.parametrize("kind", KINDS)
def test_an_ensemble_of_two_ends_with_the_weights_of_two_trainings(tmp_path, kind):
    """Sixteen steps in two epochs, with clipping, a schedule and a curriculum."""
    data = make_data()
    models = make_models(kind, data, 2)
    ensemble = Ensemble(models)
    start = [p.detach().clone() for p in models[0].parameters()]
    learner = learn(EnsembleLearner, ensemble, models[0], data)
    trainer = train(tmp_path, learner, LightningData(data, 2))
    losses = []
    for index in range(2):
        alone, loss = trained_alone(tmp_path, kind, make_data(), index)
        losses.append(loss)
        member = ensemble.member(index)
        for name, expected in alone.named_parameters():
            found = member.get_parameter(name)
            # Adam divides by the size of a gradient: rounding counts where that is near zero.
            torch.testing.assert_close(found, expected, rtol=1e-4, atol=2e-5)
    moved = [
        (a - b).abs().max() for a, b in zip(start, ensemble.member(0).parameters(), strict=True)
    ]
    assert max(moved) > 0.05
    figures = trainer.callback_metrics
    assert float(figures["train/loss"]) == pytest.approx(sum(losses) / 2, rel=1e-4)
    assert float(figures["train/loss_spread"]) > 0


def test_an_optimizer_that_would_mix_the_members_is_refused(tmp_path):
    data = make_data()
    models = make_models("acceleration", data, 2)
    learner = learn(EnsembleLearner, Ensemble(models), models[0], data, optimizer=LBFGS)
    learner._scheduler = lambda optimizer, total_steps: ConstantLR(optimizer)
    with pytest.raises(ValueError, match="optimizer is LBFGS, which mixes"):
        train(tmp_path, learner, LightningData(data, 2))


def test_one_member_that_breaks_stops_the_training(tmp_path):
    data = make_data()
    models = make_models("acceleration", data, 2)
    with torch.no_grad():
        next(models[1].parameters()).fill_(float("nan"))
    learner = learn(EnsembleLearner, Ensemble(models), models[0], data)
    with pytest.raises(NonFiniteLossError, match="became nan at step 0"):
        train(tmp_path, learner, LightningData(data, 2))


@pytest.mark.parametrize(
    ("kind", "built"), [("lnn", False), pytest.param("acceleration", True, marks=pytest.mark.slow)]
)
def test_a_compiled_ensemble_learns_what_an_uncompiled_one_does(
    tmp_path, monkeypatch, traced, kind, built
):
    """By a program for a step, and by compiled dynamics for windows of two.

    They are built of the model with the fewest loops: a mass matrix takes a minute.
    """
    if not built:
        monkeypatch.setattr(torch, "compile", lambda function: function)
    data, weights = make_data(), []
    for compile in (False, True):
        models = make_models(kind, data, 2)
        ensemble = Ensemble(models)
        train(
            tmp_path,
            learn(EnsembleLearner, ensemble, models[0], data, compile=compile),
            LightningData(data, 2),
        )
        weights.append(dict(ensemble.named_parameters()))
    for name, expected in weights[0].items():
        torch.testing.assert_close(weights[1][name], expected, rtol=1e-3, atol=2e-4)
