"""Loss and gradient as one compiled program, against autograd on the eager model."""

import copy
from functools import partial

import pytest
import torch

from pinn_dyn.ensembles import Ensemble
from pinn_dyn.ensembles.gradients import CompiledMembers
from pinn_dyn.mechanics import RK4, Rosenbrock
from pinn_dyn.mechanics.compilation import STEPS_FOR_PROGRAM
from pinn_dyn.models import (
    AccelerationMLP,
    ConstantCholesky,
    ConstantInput,
    LearnedVelocity,
    NetworkPotential,
)
from pinn_dyn.training import IncrementLoss, MidpointLoss
from pinn_dyn.training.gradients import Compiled, Eager
from tests.models.builders import make_model, make_structured, perturb
from tests.support.windows import for_members, make_windows, one_step


def value_and_gradients(engine, batch, factor=1.0):
    model = engine.model
    value = factor * engine(batch)
    gradients = torch.autograd.grad(value, list(model.parameters()), allow_unused=True)
    return value.detach(), gradients


def assert_same(found, expected, factor=1.0):
    torch.testing.assert_close(factor * found[0], expected[0], rtol=1e-12, atol=0)
    assert sum(gradient is not None for gradient in expected[1]) > 3
    for one, other in zip(found[1], expected[1], strict=True):
        assert (one is None) == (other is None)
        if other is not None:
            torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)


# Compiling is what takes the time here: one coordinate, and the two stages of the other method.
SMALL_LNN = partial(
    make_structured,
    "lnn",
    n=1,
    m=1,
    mass=ConstantCholesky,
    potential=partial(NetworkPotential, hidden=[3]),
    damping=ConstantCholesky,
    input=ConstantInput,
)
MODELS = {
    "lnn": lambda: SMALL_LNN(integrator=Rosenbrock()),
    "lnn with a learned start": lambda: SMALL_LNN(
        initial_velocity=partial(LearnedVelocity, hidden=[3])
    ),
    "acceleration with a learned start": lambda: perturb(
        AccelerationMLP(
            one_step(), hidden=[6], initial_velocity=partial(LearnedVelocity, hidden=[3])
        ).double()
    ),
}


@pytest.mark.parametrize(
    ("kind", "interpolation", "kind_of_loss", "built"),
    [
        pytest.param("lnn", "hold", IncrementLoss, True, marks=pytest.mark.slow),
        ("lnn with a learned start", "linear", IncrementLoss, False),
        ("acceleration with a learned start", "linear", IncrementLoss, False),
        ("lnn", "linear", MidpointLoss, False),
    ],
)
def test_loss_and_gradients_are_those_of_the_eager_model(
    request, monkeypatch, kind, interpolation, kind_of_loss, built
):
    """Also of other data with the same program, and of a batch in parts, one thread or three."""
    if not built:
        request.getfixturevalue("traced")
    model = MODELS[kind]()
    untouched = copy.deepcopy(model)
    windows = partial(make_windows, size=model.num_coordinates, interpolation=interpolation)
    loss = kind_of_loss(one_step(), model).double()
    compiled, eager = Compiled(loss, model, STEPS_FOR_PROGRAM), Eager(loss, untouched)
    batches = [windows(8), windows(8, seed=1), windows(24, seed=2)]
    evaluations = compiled.evaluations(batches[0])
    assert evaluations == (1 if kind_of_loss is MidpointLoss else len(model.integrator.nodes))
    parts = 2 * evaluations  # of 8 windows
    monkeypatch.setattr("pinn_dyn.training.gradients.compiled.CHUNK", parts)
    for batch, threads in zip([*batches, batches[-1]], [1, 1, 1, 3], strict=True):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        found = value_and_gradients(compiled, batch, factor=3.0)
        assert_same(found, value_and_gradients(eager, batch, factor=3.0))
    assert len(compiled._program._programs) == 1  # and none was compiled for the parts
    with torch.no_grad():
        for parameter in [*model.parameters(), *untouched.parameters()]:
            parameter *= 0.9
    found = value_and_gradients(compiled, batches[0])
    assert_same(found, value_and_gradients(eager, batches[0]))


@pytest.mark.parametrize(
    ("threads", "built"), [(1, False), pytest.param(2, True, marks=pytest.mark.slow)]
)
def test_members_of_an_ensemble_have_losses_and_gradients_of_their_own(
    request, monkeypatch, threads, built
):
    """Even in a short training: one program serves all members."""
    if not built:
        request.getfixturevalue("traced")
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    members = [perturb(AccelerationMLP(one_step(), hidden=[6]).double(), seed=k) for k in range(3)]
    stack = Ensemble(members).stack
    loss = IncrementLoss(one_step(), members[0]).double()
    compiled = CompiledMembers(loss, stack)
    batches = [make_windows(6, seed=k) for k in range(3)]
    losses = compiled(for_members(batches))
    weights = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    gradients = torch.autograd.grad((weights * losses).sum(), list(stack.parameters()))
    assert len(compiled._program._programs) == 1
    for k, (member, batch) in enumerate(zip(members, batches, strict=True)):
        assert_same(
            (losses[k], [gradient[k] for gradient in gradients]),
            value_and_gradients(Eager(loss, member), batch, factor=float(weights[k])),
            factor=float(weights[k]),
        )


@pytest.mark.parametrize("case", ["short training", "two steps"])
def test_the_program_is_for_long_trainings_on_short_windows(monkeypatch, case):
    """Its compilation takes a minute and grows with the window: there the dynamics are compiled."""
    monkeypatch.setattr(torch, "compile", lambda function: function)
    integrator = RK4(substeps=2 if case == "two steps" else 1)
    model = make_model("lnn")
    model.integrator = integrator
    loss = IncrementLoss(one_step(size=2), model).double()
    steps = STEPS_FOR_PROGRAM - (case == "short training")
    compiled, batch = Compiled(loss, model, steps), make_windows(4, size=2)
    found, expected = (value_and_gradients(one, batch) for one in (compiled, Eager(loss, model)))
    assert_same(found, expected)
    assert not compiled._program._programs
    assert model.integrator is integrator


def test_a_batch_taken_in_parts_has_the_same_loss_and_gradient(monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda function: function)
    monkeypatch.setattr("pinn_dyn.training.gradients.compiled.CHUNK", 7)
    model = make_model("lnn")
    loss = IncrementLoss(one_step(size=2), model).double()
    batch = make_windows(25, size=2)
    compiled, eager = Compiled(loss, model, steps=100), Eager(loss, model)
    assert type(compiled(batch).grad_fn) is not type(eager(batch).grad_fn)
    found, expected = (value_and_gradients(one, batch, 3.0) for one in (compiled, eager))
    assert_same(found, expected)
