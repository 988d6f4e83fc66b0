"""The weak form: exact motions balance, wrong terms do not, and the scale of the terms is fixed."""

import functools
from functools import partial

import numpy as np
import pytest
import torch
from scipy.integrate import quad, simpson
from torch._inductor import config as inductor_config

from pinn_dyn.data import draw_windows
from pinn_dyn.mechanics import Trajectory, rollout
from pinn_dyn.models import (
    CoulombFriction,
    NetworkCholesky,
    NetworkInput,
    NetworkPotential,
    Positive,
)
from pinn_dyn.systems import SoftArm
from pinn_dyn.training import ImpulseLoss
from pinn_dyn.training.impulse import input_weights, velocity_increment
from tests.models.builders import make_model, make_statistics, make_structured
from tests.support.cart_pole import CartPole
from tests.support.finite_differences import slope
from tests.support.linear import damped_oscillators, exact_solution

SAMPLES = 64
SYSTEMS = {
    "cart pole": (lambda: CartPole(), [0.2, 0.7, 0.5, -0.4], 0.6),
    "soft arm": (lambda: SoftArm(segments=1), [0.5, -0.3, 0.2, 0.3, 0.2, 0.1], 0.1),
    "linear": (lambda: damped_oscillators(), [0.4, -0.3, 0.5, 0.8], 0.8),
}


@functools.cache
def trajectory_of(kind, interpolation, samples):
    """A motion under a sampled input, as good as exact."""
    make, start, duration = SYSTEMS[kind]
    system = make().requires_grad_(False)
    t = torch.linspace(0, duration, samples + 1, dtype=torch.float64)
    u = torch.sin(t[:, None] * torch.arange(3, 3 + system.num_inputs) / duration + 0.3)
    x0 = torch.tensor(start, dtype=torch.float64)
    if kind == "linear":
        x = exact_solution(system, x0, t, u, interpolation)
    else:
        derivative = system.state_derivative
        x = rollout(derivative, x0, t, u, interpolation=interpolation, substeps=2)
    return Trajectory(t, *x.chunk(2, -1), u, interpolation=interpolation)


def motion(kind, interpolation="linear", samples=SAMPLES):
    """A system and its motion."""
    trajectory = trajectory_of(kind, interpolation, samples)
    return SYSTEMS[kind][0]().requires_grad_(False), trajectory


def error(system, trajectory, steps):
    """Root mean square of dv^ - dv over the whole trajectory, taken as one window."""
    stride = (len(trajectory.t) - 1) // steps
    windows = draw_windows([trajectory], count=1, steps=steps, stride=stride, seed=0)
    loss = ImpulseLoss(windows.statistics(), system).double()
    assert torch.equal(loss.scale, torch.ones_like(loss.scale))  # the spread of one window
    with torch.no_grad():
        return float(loss(system, windows, 0.0)) ** 0.5


@pytest.mark.parametrize("kind", SYSTEMS)
def test_on_exact_motions_the_error_falls_with_the_fourth_power_of_the_step(kind):
    system, trajectory = motion(kind)
    errors = np.array([error(system, trajectory, steps) for steps in (8, 16, 32)])
    orders = np.log2(errors[:-1] / errors[1:])
    assert (orders > 3.6).all(), orders
    assert errors[-1] < 1e-4


def test_under_a_held_input_the_error_falls_with_the_second_power():
    errors = []
    for samples in (32, 64, 128):
        system, trajectory = motion("linear", "hold", samples)
        errors.append(error(system, trajectory, samples))
        # Read as straight lines, the input would come half a step early: first order.
        lines = Trajectory(trajectory.t, trajectory.q, trajectory.v, trajectory.u)
        assert error(system, lines, samples) > 10 * errors[-1]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 1.75).all(), orders


class Wrong(CartPole):
    """A cart pole with one term that is wrong."""

    wrong = ""

    def mass_matrix(self, q):
        return super().mass_matrix(q) * (1.02 if self.wrong == "M" else 1)

    def damping_matrix(self, q):
        return super().damping_matrix(q) * (1.1 if self.wrong == "D" else 1)

    def input_matrix(self, q):
        return super().input_matrix(q) * (1.02 if self.wrong == "A" else 1)

    def potential_energy(self, q):
        return super().potential_energy(q) * (1.02 if self.wrong == "V" else 1)

    def _friction_force(self, v):
        return 0.05 * torch.tanh(v) if self.wrong == "F" else torch.zeros_like(v)

    def _kinetic_gradient(self, q, v):
        return super()._kinetic_gradient(q, v) * (0.9 if self.wrong == "kinetic gradient" else 1)


@pytest.mark.parametrize("term", ["M", "D", "V", "A", "F", "kinetic gradient"])
def test_a_wrong_term_is_seen(term):
    _, trajectory = motion("cart pole")
    system = Wrong().requires_grad_(False)
    assert error(system, trajectory, 32) < 1e-6
    system.wrong = term
    assert error(system, trajectory, 32) > 1e-3


def as_function(samples, interpolation):
    """The input between its samples at 0, 1, 2, ..."""
    if interpolation == "linear":
        return lambda x: np.interp(x, np.arange(len(samples)), samples)
    return lambda x: samples[min(int(x), len(samples) - 2)]


@pytest.mark.parametrize("interpolation", ["linear", "hold"])
@pytest.mark.parametrize(("steps", "stride"), [(2, 1), (2, 3), (4, 1), (6, 5)])
def test_the_weights_integrate_a_parabola_times_the_input(steps, stride, interpolation):
    rng = np.random.default_rng(0)
    a, u = rng.normal(size=steps + 1), rng.normal(size=steps * stride + 1)
    signal = as_function(u, interpolation)
    expected = 0.0
    for node in range(0, steps, 2):
        parabola = np.polyfit(np.arange(node, node + 3) * stride, a[node : node + 3], 2)
        for k in range(node * stride, (node + 2) * stride):
            expected += quad(lambda x, p=parabola: np.polyval(p, x) * signal(x), k, k + 1)[0]
    weights = input_weights(steps, stride, interpolation).numpy()
    assert weights.shape == (steps + 1, steps * stride + 1)
    # In units of a step, which is ``stride`` samples long.
    assert a @ weights @ u == pytest.approx(expected / stride, abs=1e-12)
    assert a @ weights.sum(1) == pytest.approx(simpson(a, dx=1.0), abs=1e-12)


def random_windows(n=2, m=2, count=5, steps=2):
    generator = torch.Generator().manual_seed(4)
    t = torch.arange(40, dtype=torch.float64) * 0.02
    q, v, u = (
        torch.randn(40, k, generator=generator, dtype=torch.float64).cumsum(0) * 0.3
        for k in (n, n, m)
    )
    return draw_windows([Trajectory(t, q, v, u)], count=count, steps=steps, stride=2, seed=0)


def make_loss(model):
    windows = random_windows(model.num_coordinates, model.num_inputs)
    return ImpulseLoss(windows.statistics(), model).double(), windows


@pytest.mark.parametrize("kind", ["lnn", "hnn"])
def test_gradients_of_single_weights_are_finite_differences(kind):
    model = make_structured(kind, 2, 2)
    loss, windows = make_loss(model)
    loss(model, windows, 0.0).backward()
    parameters = dict(model.named_parameters())
    largest = max(float(p.grad.abs().max()) for p in parameters.values() if p.grad is not None)
    checked = 0
    for name, parameter in parameters.items():
        flat = parameter.detach().view(-1)
        index = len(flat) // 2
        start = float(flat[index])

        def shifted(e, flat=flat, index=index, start=start):
            flat[index] = start + e
            with torch.no_grad():
                value = loss(model, windows, 0.0)
            flat[index] = start
            return value

        expected = float(slope(shifted))
        actual = 0.0 if parameter.grad is None else float(parameter.grad.view(-1)[index])
        assert abs(actual - expected) < 1e-7 * (largest + abs(expected)), name
        checked += abs(expected) > 1e-4 * largest
    assert checked > len(parameters) / 2


@pytest.mark.parametrize("kind", ["lnn", "hnn"])
def test_the_predicted_velocity_balances_momentum_and_impulse(kind):
    """M(q_H) (v_0 + dv^) - M(q_0) v_0 = J, with J summed node by node from the energies."""
    model = make_structured(kind, 2, 2, friction=CoulombFriction)
    _, windows = make_loss(model)
    weights = input_weights(2, 2, "linear") * windows.t[1]
    q = torch.cat([windows.q[:, None], windows.q[:, None] + windows.dq], 1)
    v = torch.cat([windows.v[:, None], windows.v[:, None] + windows.dv], 1)
    with torch.no_grad():
        dv = velocity_increment(model, q, v, weights.sum(1), weights @ windows.u)
        for b in range(len(q)):
            impulse = 0
            for j in range(3):
                qj, vj = q[b, j], v[b, j]

                def lagrangian(x, vj=vj):
                    return 0.5 * vj @ model.mass_matrix(x) @ vj - model.potential_energy(x)

                loss = model.damping_matrix(qj) @ vj + model.friction(vj)
                impulse += weights[j].sum() * (torch.func.grad(lagrangian)(qj) - loss)
                impulse += model.input_matrix(qj) @ (weights[j] @ windows.u[b])
            end = model.mass_matrix(q[b, -1]) @ (v[b, 0] + dv[b])
            start = model.mass_matrix(q[b, 0]) @ v[b, 0]
            torch.testing.assert_close(end - start, impulse, rtol=1e-9, atol=1e-9)


def scale_terms(model, factor):
    """Multiply M, D, V and A of a Lagrangian network by a factor."""
    for factor_of_matrix in (model.mass, model.damping):
        factor_of_matrix.placement *= factor**0.5
    model.potential.scale *= factor
    model.input.scale *= factor


@pytest.mark.parametrize("factor", [2.0, 1e-6])
def test_a_common_factor_of_all_terms_changes_nothing(factor):
    """So terms that all go to zero gain nothing, though they then balance."""
    model = make_structured("lnn", 2, 2)
    loss, windows = make_loss(model)
    before = float(loss(model, windows, 0.0).detach())
    mass = model.mass_matrix(windows.q)
    scale_terms(model, factor)
    torch.testing.assert_close(model.mass_matrix(windows.q), factor * mass)
    assert before > 0.1
    assert float(loss(model, windows, 0.0).detach()) == pytest.approx(before, rel=1e-9)


def test_forces_that_go_to_zero_alone_do_not_solve_it():
    """What is left then is a motion without forces, far from the measured one."""
    system, trajectory = motion("linear")
    assert error(system, trajectory, 8) < 1e-3
    for force in (system.stiffness, system.damping, system.inputs):
        force *= 1e-9
    moved = (trajectory.v[-1] - trajectory.v[0]).square().mean().sqrt()
    assert error(system, trajectory, 8) == pytest.approx(float(moved), rel=1e-6)


def test_the_residual_counts_in_units_of_the_spread_of_the_velocity_increment():
    model = make_structured("lnn", 2, 2)
    loss, windows = make_loss(model)
    spread = windows.dv[:, -1].std(0, correction=0)
    torch.testing.assert_close(loss.scale, spread, rtol=1e-6, atol=0)
    before = float(loss(model, windows, 0.0).detach())
    loss.scale *= 3
    assert float(loss(model, windows, 0.0).detach()) == pytest.approx(before / 9)


def test_a_black_box_is_refused_with_what_to_use():
    with pytest.raises(TypeError, match=r"is a NextStateMLP.*use loss=increment"):
        ImpulseLoss(make_statistics(2, 2), make_model("next_state"))


def test_an_odd_number_of_steps_is_refused():
    statistics = random_windows(steps=3).statistics()
    with pytest.raises(ValueError, match=r"3 steps, expected an even number.*data.steps=2"):
        ImpulseLoss(statistics, make_structured("lnn", 2, 2))


def test_the_loss_has_nothing_to_learn_or_to_save():
    loss, _ = make_loss(make_structured("lnn", 2, 2))
    assert not list(loss.parameters())
    assert not loss.state_dict()


@pytest.mark.slow
@inductor_config.patch({"cpp.simdlen": 1, "compile_threads": 1})  # it builds faster
def test_compiled_it_has_the_same_value_and_gradients():
    # Few small layers: compiling takes longer the more there are.
    model = make_structured(
        "lnn",
        2,
        2,
        mass=partial(NetworkCholesky, hidden=[4]),
        potential=partial(NetworkPotential, hidden=[4]),
        damping=partial(NetworkCholesky, hidden=[], positivity=Positive(floor=0.0)),
        input=partial(NetworkInput, hidden=[]),
        dtype=torch.float32,
    )
    loss, windows = make_loss(model)
    loss, windows = loss.float(), windows.to(torch.device("cpu"), torch.float32)
    parameters = list(model.parameters())

    def value_and_gradients():
        value = loss(model, windows, 0.0)
        gradients = torch.autograd.grad(
            value, parameters, allow_unused=True, materialize_grads=True
        )
        return float(value.detach()), gradients

    expected, expected_gradients = value_and_gradients()
    eager = loss._increment
    loss.compile_dynamics(model, steps=100)
    assert loss._increment is not eager
    actual, gradients = value_and_gradients()
    assert actual == pytest.approx(expected, rel=1e-4)
    overall = max(float(g.abs().max()) for g in expected_gradients)
    for a, e in zip(gradients, expected_gradients, strict=True):
        assert float((a - e).abs().max()) <= 1e-4 * max(float(e.abs().max()), 1e-2 * overall)
