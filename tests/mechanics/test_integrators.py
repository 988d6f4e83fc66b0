"""One-step methods: RK4 against torchdiffeq's, the Rosenbrock method against exact solutions."""

from functools import partial

import pytest
import torch
from torchdiffeq import odeint

from pinn_dyn.mechanics import RK4, Rosenbrock, Signal
from pinn_dyn.mechanics.compilation import CompiledDynamics, integrated_by
from pinn_dyn.mechanics.integrators import Wrapped
from pinn_dyn.mechanics.rollout import path_between, step_grid
from pinn_dyn.models import ConstantCholesky, ConstantInput, NetworkPotential
from pinn_dyn.testing import LinearSystem, damped_oscillators, exact_solution
from tests.models.builders import make_structured


def samples(batch, count, size, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*batch, count, size, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
@pytest.mark.parametrize(("batch", "substeps"), [((2, 3), 1), ((), 3)])
def test_the_loop_gives_what_torchdiffeq_gives(interpolation, batch, substeps):
    """More steps than a block, an input that jumps, and solution times that skip samples."""
    system = damped_oscillators().requires_grad_(False)
    count = 140 // substeps + 1
    t_input = 0.02 * torch.arange(count, dtype=torch.float64)
    u = samples(batch, count, 1)
    x0 = samples(batch, 1, 4, seed=1).squeeze(-2)
    signal, t = Signal(t_input, u, interpolation), t_input[::2]
    path = path_between(system, Wrapped(RK4(substeps)), x0, t, signal)

    def rate(time, x):
        return system.state_derivative(x, signal.at(time[None])[0])

    grid, held = step_grid(t, t_input, substeps), interpolation == "hold"
    expected = odeint(rate, x0, grid, method="rk4", options={"perturb": held})[::substeps]
    assert path.shape == (*batch, 140 // substeps // 2 + 1, 4)
    torch.testing.assert_close(path, expected.movedim(0, -2) - x0[..., None, :], rtol=0, atol=1e-12)


# The Rosenbrock method.


def overdamped(rate):
    """A mass that its damper stops in 1/rate seconds, on a spring that takes a second."""
    return LinearSystem([[1 / rate]], [[1.0]], [[1.0]], [[1.0]]).requires_grad_(False)


def rosenbrock_path(system, x0, t, u, interpolation, substeps=1):
    system.integrator = Rosenbrock(substeps)
    return system.predict(x0, t, Signal(t, u, interpolation))


@pytest.mark.parametrize("state", ["qv", "qp"])
def test_the_rosenbrock_method_takes_steps_far_longer_than_the_damping(state):
    """Steps of 0.1 s where the damper acts in 0.1 ms: RK4 would need steps below 0.3 ms."""
    system = overdamped(rate=1e4)
    system.state = state
    t = 0.1 * torch.arange(21, dtype=torch.float64)
    u = torch.sin(t)[:, None]
    start = torch.tensor([0.3, 0.5], dtype=torch.float64)
    expected = exact_solution(system, start, t, u, "linear")[:, 0]
    x0 = start if state == "qv" else start * torch.tensor([1.0, 1e-4])
    found = rosenbrock_path(system, x0, t, u, "linear")[:, 0]
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-3)
    system.integrator = RK4()
    assert not (system.predict(x0, t, Signal(t, u))[:, 0].abs() < 1e3).all()


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
def test_a_rosenbrock_step_over_many_samples_of_the_input_loses_no_impulse(interpolation):
    """A body without inertia or spring follows its input: q is the integral of u."""
    system = LinearSystem([[1e-6]], [[0.0]], [[1.0]], [[1.0]]).requires_grad_(False)
    system.integrator = Rosenbrock()
    t = 0.02 * torch.arange(51, dtype=torch.float64)
    u = samples((), 51, 1)
    left, right = (u[:-1], u[:-1]) if interpolation == "hold" else (u[:-1], u[1:])
    moved = torch.cat([torch.zeros(1).double(), ((left + right) / 2 * 0.02).cumsum(0)[:, 0]])
    x0 = torch.zeros(2, dtype=torch.float64)
    found = system.predict(x0, t[::10], Signal(t, u, interpolation))[:, 0]
    assert moved[::10].diff().abs().max() > 0.04
    torch.testing.assert_close(found, moved[::10], rtol=0, atol=1e-4)


@pytest.mark.slow
def test_a_compiled_rosenbrock_step_has_the_same_increments_and_gradients(monkeypatch):
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="aot_eager"))
    t = 0.02 * torch.arange(4, dtype=torch.float64)
    u, x0 = samples((4,), 4, 1), 0.3 * samples((4,), 1, 2, seed=1).squeeze(-2)
    constant = dict(mass=ConstantCholesky, damping=ConstantCholesky, input=ConstantInput)
    potential = partial(NetworkPotential, hidden=[3])
    model = make_structured("lnn", 1, 1, **constant, potential=potential, integrator=Rosenbrock())
    expected = model.increments(x0, t, Signal(t, u))
    # All but the constant of V, which moves nothing.
    parameters = [
        value
        for name, value in model.named_parameters()
        if name != "potential.network.layers.1.bias"
    ]
    gradients = torch.autograd.grad(expected.square().sum(), parameters)
    with integrated_by(model, CompiledDynamics(model.integrator, model)):
        found = model.increments(x0, t, Signal(t, u))
    for one, other in zip(
        torch.autograd.grad(found.square().sum(), parameters), gradients, strict=True
    ):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
