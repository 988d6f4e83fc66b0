"""What only a GPU does: compiled programs as CUDA graphs, and trainings there."""

import copy

import pytest
import torch

from pinn_dyn.data import LightningData
from pinn_dyn.evaluation.prediction import model_for_rollouts
from pinn_dyn.mechanics import Signal, double_copy
from pinn_dyn.mechanics.compilation import STEPS_FOR_PROGRAM
from pinn_dyn.training import (
    DynamicsLearner,
    IncrementLoss,
    MidpointLoss,
    NonFiniteLossError,
    ParameterVector,
)
from pinn_dyn.training.gradients import Compiled, Eager
from tests.models.builders import make_model, perturb
from tests.support.small_trainings import learn, make_data, make_models, train
from tests.support.windows import make_windows, one_step

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU with CUDA")
GPU = torch.device("cuda")


def batches_of(size):
    return [make_windows(size, size=2, seed=seed) for seed in range(3)]


@pytest.mark.parametrize(("kind", "kind_of_loss"), [("lnn", MidpointLoss), ("hnn", IncrementLoss)])
def test_a_recorded_program_gives_the_loss_and_gradient_of_the_eager_model_on_a_cpu(
    kind, kind_of_loss
):
    """Also of other data and other weights than those it was recorded with."""
    model = make_model(kind)
    moved = copy.deepcopy(model).to(GPU)
    loss = kind_of_loss(one_step(size=2), model).double()
    compiled = Compiled(
        copy.deepcopy(loss).to(GPU), moved, ParameterVector(moved.parameters()), STEPS_FOR_PROGRAM
    )
    eager = Eager(loss, model, ParameterVector(model.parameters()))
    kept = []
    for batch in batches_of(8):
        found, expected = compiled(batch.to(GPU)), eager(batch)
        kept.append((found, [value.clone() for value in found]))
        for a, b in zip(found, expected, strict=True):
            torch.testing.assert_close(a.cpu(), b, rtol=1e-9, atol=1e-12)
        with torch.no_grad():
            eager.vector.values.mul_(0.9)
            compiled.vector.values.mul_(0.9)
    assert len(compiled._program._programs) == 1
    for found, at_once in kept:  # a later step does not write over what an earlier one gave
        assert all(map(torch.equal, found, at_once))


@pytest.mark.parametrize("compile", [False, True])
@pytest.mark.parametrize("kind", ["lnn", "hnn", "next state"])
def test_a_training_ends_with_the_weights_that_it_has_on_a_cpu(tmp_path, kind, compile):
    """Sixteen steps in two epochs, with clipping, a schedule and a curriculum."""
    ends = []
    for accelerator in ("cpu", "gpu"):
        data = make_data()
        model = make_models(kind, data, 1)[0]
        compiled = compile and accelerator == "gpu"
        learner = learn(DynamicsLearner, model, model, data, compile=compiled)
        train(tmp_path, learner, LightningData(data), accelerator=accelerator)
        ends.append([p.detach().cpu() for p in model.parameters()])
    for found, expected in zip(*ends, strict=True):
        # Adam divides by the size of a gradient: rounding counts where that is near zero.
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=2e-4)


def start_and_input():
    """x0 ``(3, 4)``, times of 100 steps, and u ``(3, 101, 2)``."""
    x0 = 0.3 * torch.randn(3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    t = 0.01 * torch.arange(101, dtype=torch.float64)
    return x0, t, torch.stack([t.sin(), t.cos()], dim=-1).expand(3, -1, -1)


@torch.no_grad()
def assert_rolls_out_the_same(on_gpu, model):
    x0, t, u = start_and_input()
    found = on_gpu.predict(x0.to(GPU), t.to(GPU), Signal(t.to(GPU), u.to(GPU)))
    expected = double_copy(model).predict(x0, t, Signal(t, u))
    torch.testing.assert_close(found.cpu(), expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("kind", ["lnn", "hnn"])
def test_a_rollout_by_recorded_steps_is_that_of_a_cpu(kind):
    model = perturb(make_model(kind))
    on_gpu = model_for_rollouts(model, GPU)
    on_gpu.integrator.inner.path = None  # what would be called, were a step not recorded
    assert_rolls_out_the_same(on_gpu, model)


def test_dynamics_that_wait_for_the_gpu_are_integrated_without_a_record(monkeypatch):
    model = perturb(make_model("lnn"))
    derivative = type(model).state_derivative

    def waiting(self, x, u):
        assert float(x.sum()) < 1e9
        return derivative(self, x, u)

    monkeypatch.setattr(type(model), "state_derivative", waiting)
    assert_rolls_out_the_same(model_for_rollouts(model, GPU), model)


def test_a_loss_that_is_not_a_number_is_found_though_the_steps_run_ahead(tmp_path):
    data = make_data()
    model = make_models("lnn", data, 1)[0]
    learner = learn(DynamicsLearner, model, model, data)
    with torch.no_grad():
        next(model.parameters()).fill_(float("nan"))
    with pytest.raises(NonFiniteLossError, match="became nan at step 0"):
        train(tmp_path, learner, LightningData(data), accelerator="gpu")
