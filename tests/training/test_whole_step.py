"""Loss and gradient as one compiled program, against autograd on the eager model."""

import copy
from dataclasses import replace
from functools import partial

import pytest
import torch

from pinn_dyn.data import Windows
from pinn_dyn.mechanics import Ensemble
from pinn_dyn.models import (
    AccelerationMLP,
    ConstantCholesky,
    ConstantInput,
    LagrangianNetwork,
    LearnedVelocity,
    NetworkPotential,
)
from pinn_dyn.training import IncrementLoss, MidpointLoss
from pinn_dyn.training.losses import STEPS_FOR_WHOLE as LONG
from tests.models.builders import STEP, make_model, make_statistics, make_structured, perturb


def make_windows(count, size=1, interpolation="linear", seed=0):
    """Windows of one step, with an input that jumps within it."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return 0.3 * torch.randn(*shape, generator=generator, dtype=torch.float64)

    return Windows(
        t=torch.tensor([0.0, STEP], dtype=torch.float64),
        t_input=torch.linspace(0, STEP, 3, dtype=torch.float64),
        q=normal(count, size),
        v=normal(count, size),
        p=normal(count, size),
        dq=STEP * normal(count, 1, size),
        dv=STEP * normal(count, 1, size),
        dp=STEP * normal(count, 1, size),
        u=normal(count, 3, size),
        interpolation=interpolation,
    )


def one_step(size=1):
    scales = make_statistics(size, size)
    return replace(
        scales,
        velocity_increment_std=scales.velocity_increment_std[:1],
        momentum_increment_std=scales.momentum_increment_std[:1],
    )


def value_and_gradients(loss, model, batch, factor=1.0):
    value = factor * loss(model, batch, 0.0)
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
    "lnn": lambda: SMALL_LNN(integrator="rosenbrock"),
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
    untouched = copy.deepcopy(model)  # compile_dynamics also compiles the model's derivative
    windows = partial(make_windows, size=model.num_coordinates, interpolation=interpolation)
    eager, compiled = (kind_of_loss(one_step(), model).double() for _ in range(2))
    compiled.compile_dynamics(model, LONG)
    batches = [windows(8), windows(8, seed=1), windows(24, seed=2)]
    evaluations = compiled.evaluations(model, batches[0])
    monkeypatch.setattr("pinn_dyn.training.whole_step.CHUNK", 2 * evaluations)  # parts of 8
    for batch, threads in zip([*batches, batches[-1]], [1, 1, 1, 3], strict=True):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        assert_same(
            value_and_gradients(compiled, model, batch, factor=3.0),
            value_and_gradients(eager, untouched, batch, factor=3.0),
        )
    assert len(compiled._whole._programs) == 1  # and none was compiled for the parts
    with torch.no_grad():
        for parameter in [*model.parameters(), *untouched.parameters()]:
            parameter *= 0.9
    assert_same(
        value_and_gradients(compiled, model, batches[0]),
        value_and_gradients(eager, untouched, batches[0]),
    )


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
    compiled, eager = (IncrementLoss(one_step(), members[0]).double() for _ in range(2))
    compiled.compile_dynamics(stack, 0)
    batches = [make_windows(6, seed=k) for k in range(3)]
    rows = {
        name: torch.stack([getattr(batch, name) for batch in batches])
        for name in ("q", "v", "p", "dq", "dv", "dp", "u")
    }
    losses = compiled(stack, replace(batches[0], **rows), 0.0)
    weights = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    gradients = torch.autograd.grad((weights * losses).sum(), list(stack.parameters()))
    assert len(compiled._whole._programs) == 1
    for k, (member, batch) in enumerate(zip(members, batches, strict=True)):
        assert_same(
            (losses[k], [gradient[k] for gradient in gradients]),
            value_and_gradients(eager, member, batch, factor=float(weights[k])),
            factor=float(weights[k]),
        )


@pytest.mark.parametrize("case", ["eager", "short training", "without gradients", "two steps"])
def test_the_program_is_for_long_trainings_on_short_windows(monkeypatch, case):
    """Its compilation takes a minute and grows with the window; validation runs eagerly."""
    model = make_model("lnn")
    assert isinstance(model, LagrangianNetwork)
    loss = IncrementLoss(one_step(size=2), model).double()
    monkeypatch.setattr(model, "compile_derivative", lambda: None)
    batch = make_windows(4, size=2)
    if case != "eager":
        loss.compile_dynamics(model, LONG - (case == "short training"))
    if case == "two steps":
        model.substeps = 2
    with torch.set_grad_enabled(case != "without gradients"):
        value = loss(model, batch, 0.0)
    assert torch.isfinite(value).all()
    assert loss._whole is None
