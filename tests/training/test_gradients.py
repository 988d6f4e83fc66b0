"""Loss and gradient as one compiled program, against autograd on the eager model."""

import copy
from dataclasses import replace
from functools import partial

import pytest
import torch

from pinn_dyn.mechanics import RK4, Rosenbrock
from pinn_dyn.mechanics.compilation import STEPS_FOR_PROGRAM
from pinn_dyn.models import (
    AccelerationMLP,
    ConstantCholesky,
    ConstantInput,
    CoulombFriction,
    LagrangianNetwork,
    LearnedVelocity,
    NetworkPotential,
)
from pinn_dyn.training import IncrementLoss, MidpointLoss, ParameterVector
from pinn_dyn.training.gradients import Compiled, Eager
from pinn_dyn.training.loss_program import LossProgram
from tests.models.builders import make_model, make_structured, perturb
from tests.support.known import known_model, statistics, windows_of
from tests.support.windows import make_windows, one_step, spread_out


def engine(kind, loss, model, *steps):
    """The engine, and the vector of the parameters of the model."""
    return kind(loss, model, ParameterVector(model.parameters()), *steps)


def assert_same(found, expected):
    """Losses and gradients, of which the eager one is that of autograd."""
    torch.testing.assert_close(found[0], expected[0], rtol=1e-12, atol=0)
    assert (expected[1] != 0).sum() > 3
    torch.testing.assert_close(found[1], expected[1], rtol=1e-9, atol=1e-12)


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
    """Also of other data with the same program, and of a batch in parts, one thread or three.

    The other data lie in memory otherwise.
    """
    if not built:
        request.getfixturevalue("traced")
    model = MODELS[kind]()
    untouched = copy.deepcopy(model)
    windows = partial(make_windows, size=model.num_coordinates, interpolation=interpolation)
    loss = kind_of_loss(one_step(), model).double()
    compiled = engine(Compiled, loss, model, STEPS_FOR_PROGRAM)
    eager = engine(Eager, loss, untouched)
    batches = [windows(8), spread_out(windows(8, seed=1)), windows(24, seed=2)]
    evaluations = loss.evaluations(model, steps=1)
    assert evaluations == (1 if kind_of_loss is MidpointLoss else len(model.integrator.nodes))
    parts = 2 * evaluations  # of 8 windows
    monkeypatch.setattr("pinn_dyn.training.gradients.CHUNK", parts)
    for batch, threads in zip([*batches, batches[-1]], [1, 1, 1, 3], strict=True):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        assert_same(compiled(batch), eager(batch))
    assert len(compiled._program._programs) == 1  # and none was compiled for the parts
    with torch.no_grad():
        for parameter in [*model.parameters(), *untouched.parameters()]:
            parameter *= 0.9
    assert_same(compiled(batches[0]), eager(batches[0]))


@pytest.mark.slow
def test_the_program_of_a_robot_with_twelve_joints_compiles():
    """Seven joints with RK4 windows compile for ten minutes, which is too long for a test.

    ``python benchmarks/training_loop.py --sizes 7 --losses increment`` does it.
    """
    size = 12
    statistics = replace(one_step(size), v_std=torch.ones(size, dtype=torch.float64))
    model = perturb(LagrangianNetwork(statistics).double(), spread=0.01)
    loss = MidpointLoss(statistics, model).double()
    windows = make_windows(4, size=size)
    program = LossProgram(loss, model, ParameterVector(model.parameters()))
    assert_same(program(windows, part=4), engine(Eager, loss, model)(windows))


@pytest.mark.parametrize("size", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_an_experimental_option_of_the_compiler_cannot_end_a_training(monkeypatch, size):
    """Small programs are compiled again without it, and large ones never get it."""
    tried = []

    def compiled(graph, arguments, options):
        tried.append("memory_planning" in options)
        if tried[-1]:
            graph.graph.erase_node(next(iter(reversed(graph.graph.nodes))))  # half done
            raise RecursionError
        return graph

    monkeypatch.setattr("torch._inductor.compile", compiled)
    monkeypatch.setattr("pinn_dyn.mechanics.compilation.LARGEST_PLANNED", 2000)
    model = SMALL_LNN(n=size, m=size)
    loss = IncrementLoss(one_step(size), model).double()
    windows = make_windows(4, size=size)
    program = LossProgram(loss, model, ParameterVector(model.parameters()))
    assert_same(program(windows, part=4), engine(Eager, loss, model)(windows))
    assert tried == ([True, False] if size == 1 else [False])


@pytest.mark.parametrize("case", ["short training", "two steps"])
def test_the_program_is_for_long_trainings_on_short_windows(monkeypatch, case):
    """Its compilation takes a minute and grows with the window: there the dynamics are compiled."""
    monkeypatch.setattr(torch, "compile", lambda function: function)
    integrator = RK4(substeps=2 if case == "two steps" else 1)
    model = make_model("lnn")
    model.integrator = integrator
    loss = IncrementLoss(one_step(size=2), model).double()
    steps = STEPS_FOR_PROGRAM - (case == "short training")
    compiled, batch = engine(Compiled, loss, model, steps), make_windows(4, size=2)
    assert_same(compiled(batch), Eager(loss, model, compiled.vector)(batch))
    assert not compiled._program._programs
    assert model.integrator is integrator


def test_a_batch_taken_in_parts_has_the_same_loss_and_gradient(monkeypatch):
    monkeypatch.setattr(torch, "compile", lambda function: function)
    monkeypatch.setattr("pinn_dyn.training.gradients.CHUNK", 7)
    model = make_model("lnn")
    loss = IncrementLoss(one_step(size=2), model).double()
    batch = make_windows(25, size=2)
    compiled = engine(Compiled, loss, model, 100)
    seen, of_part = [], compiled._loss_and_gradient
    monkeypatch.setattr(
        compiled, "_loss_and_gradient", lambda part: seen.append(len(part)) or of_part(part)
    )
    assert_same(compiled(batch), Eager(loss, model, compiled.vector)(batch))
    assert seen == [9, 8, 8]


def test_joints_that_stick_are_compiled_without_a_program():
    """Their rollouts do not call the state derivative, which the size of a program counts."""
    model = known_model(friction=CoulombFriction)
    windows = windows_of(model, count=4, steps=2)
    loss = IncrementLoss(statistics(model.num_coordinates), model).double()
    assert model.sticking
    assert engine(Compiled, loss, model, STEPS_FOR_PROGRAM).step(windows, None) is None
