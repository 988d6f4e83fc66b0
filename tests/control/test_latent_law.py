"""The law in latent coordinates, on a plant of oscillators whose constants are not the model's."""

import copy

import numpy as np
import pytest
import torch

from pinn_dyn.control import (
    Actuator,
    LatentLaw,
    MotorPID,
    Pipeline,
    SetPoint,
    close_loop,
)
from pinn_dyn.control.contracts import Motion, Plant, Reference
from pinn_dyn.models import CoupledOscillators
from pinn_dyn.testing import LinearSystem
from tests.models.builders import STEP, make_statistics


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(3)
    sizes = {"oscillators": 6, "hidden": [8], "force_hidden": [8]}
    model = CoupledOscillators(make_statistics(2, 2), **sizes)
    with torch.no_grad():
        for part in (model.output, model.force):  # nearly linear, so that set points can be held
            part.layers[-1].weight.mul_(0.2)
    return model.double().requires_grad_(False)


class Oscillators(Plant):
    """The equations of a model with other stiffness, damping and output, at its own step."""

    num_coordinates = num_inputs = 2

    def __init__(self, model):
        self.model = copy.deepcopy(model)
        generator = torch.Generator().manual_seed(1)
        for name in ("stiffness", "damping", "coupling"):
            value = getattr(self.model, name)
            noise = torch.randn(value.shape, generator=generator, dtype=value.dtype)
            value.add_(0.05 * noise.tril())
        self.model.mean[:2].add_(0.1 * self.model.std[:2])

    def start(self, q0, v0):
        u = torch.zeros_like(q0)
        self.x = self.model.start(q0, v0, u, q0[:, :0], u[:, :0])[:, : 2 * len(self.model.bias)]

    def advance(self, u, duration):
        ratio = duration / self.model.fixed_step
        A, B = self.model.flow(ratio)
        n = len(self.model.bias)
        force = self.model.latent_force(u) - self.model.coupling_force(self.x[:, :n])
        self.x = self.x @ A.mT + force @ B.mT
        q = self.model.observe(self.x)
        return q, torch.zeros_like(q)


class SetPoints(Reference):
    """Two constant configurations."""

    num_coordinates = 2

    def __init__(self, q):
        self.q = q

    def __call__(self, t):
        return Motion(self.q, 0 * self.q, 0 * self.q)


def closed(model, law, *, dead_time=0.0, rate=1 / STEP, actuator=None):
    """Return a loop to two set points that the plant can hold, and the lengths of the steps."""
    plant = Oscillators(model)
    u = model.mean[-2:] + model.std[-2:] * torch.tensor([[0.5, -0.3], [-0.4, 0.6]]).double()
    targets = plant.model.rest(u)[1]
    start = plant.model.rest(torch.zeros(2, 2).double())[1]
    record = close_loop(
        plant,
        law,
        SetPoints(targets),
        start,
        0 * start,
        duration=150 / rate,
        rate=rate,
        dead_time=dead_time,
        actuator=actuator,
    )
    assert record.stopped == [None, None]
    return record, (targets - start).norm(dim=-1)


def errors(*arguments, **settings):
    """Return |q - q_ref| over time, ``(2, T)``, and the lengths of the steps."""
    record, steps = closed(*arguments, **settings)
    return (record.q - record.reference.q).norm(dim=-1), steps


@pytest.mark.parametrize(("periods", "share"), [(0.0, 1.0), (2.5, 0.5)])
def test_the_steady_state_error_vanishes_with_a_wrong_model(model, periods, share):
    """Rates of one and two calls per step of the model, with dead times."""
    period = share * STEP
    law = LatentLaw(model, 0.5, 0.5 * STEP, 0.2 / STEP, dead_time=periods * period, noise=0.01)
    found, steps = errors(model, law, dead_time=periods * period, rate=1 / period)
    assert (found[:, -1] < 1e-3 * steps).all()
    short, _ = errors(model, LatentLaw(model, 0.5, 0.5 * STEP, 1e-6), rate=1 / period)
    assert (short[:, -1] > 0.01 * steps).any()  # the model is wrong


@pytest.mark.parametrize(("gain", "share"), [(10.0, 0.25), (1000.0, 2.0)])
def test_no_gain_and_no_rate_is_too_large_for_the_model(model, gain, share):
    """The energy of the model, linear and with the spring of the law, never rises."""
    law = LatentLaw(model, gain, gain * STEP, 0.2 / STEP)
    u, n, ratio = model.mean[-2:], len(model.bias), share
    at = model.linearize(u)
    A, B = model.transition(at, ratio)
    F = at.input * model.std[-2:]
    compliant = torch.linalg.solve(at.stiffness, F)
    spring = gain * F @ torch.linalg.solve(F.T @ compliant, F.T)
    law = Pipeline(law, share * STEP).law
    known = F, compliant, at.z, torch.zeros(1, n).double(), u[None]
    x = 1e-5 * torch.randn(1, 2 * n, generator=torch.manual_seed(0)).double()
    rest = torch.cat([at.z, torch.zeros_like(at.z)])
    energies = []
    for _ in range(50):
        z, v = x[0].chunk(2)
        energies.append(z @ (at.stiffness + spring) @ z + v @ v)
        feedback = law._feedback(rest + x, *known)
        x = x @ A.T + (feedback * model.std[-2:]) @ B.T
    energies = torch.stack(energies)
    # Up to what the linearization of the step leaves.
    assert (energies.diff() <= 1e-3 * energies[:-1]).all()
    assert energies[-1] < 0.2 * energies[0]


def test_the_velocity_of_the_reference_reduces_the_lag(model):
    """A slow ramp: damping against z_d' does not hold the robot back."""
    start, end = model.rest(model.mean[-2:] + torch.tensor([[-0.3], [0.3]]) * model.std[-2:])[1]
    seconds = 150 * STEP

    class Ramp(Reference):
        num_coordinates = 2

        def __init__(self, known):
            self.known = known

        def __call__(self, t):
            v = (end - start) / seconds
            return Motion(start + v * t, self.known * v, 0 * v)

    lags = []
    for known in (1.0, 0.0):
        law = LatentLaw(model, 0.5, 2 * STEP, 0.2 / STEP)
        q0 = start[None]
        setting = dict(duration=seconds, rate=1 / STEP)
        record = close_loop(Oscillators(model), law, Ramp(known), q0, 0 * q0, **setting)
        lags.append((record.q - record.reference.q)[0, 100:].norm(dim=-1).mean())
    assert lags[0] < 0.8 * lags[1]


def test_the_error_of_the_observer_decays_at_any_rate(model):
    law = LatentLaw(model, 1.0, 0.0, 0.2 / STEP)
    for period in (0.05 * STEP, STEP, 20 * STEP):
        gain, matrix = law.observer_gain(period)
        assert abs(law.observer_poles(period)).max() < 1
        # The matrix moves the error: linear steps with and without a wrong start.
        A, B = model.transition(model.linearize(model.mean[-2:]), period / STEP)
        C = torch.cat([law._center.output / model.std[:2, None], torch.eye(2)], 1)
        generator = torch.Generator().manual_seed(0)
        truth, estimate = torch.randn(2, A.shape[0] + 2, 1, generator=generator).double()
        u = torch.randn(2, 1, generator=generator).double()
        F = torch.block_diag(A, torch.eye(2).double())
        later = F @ truth
        later[: len(A)] += B @ u
        moved = F @ estimate + gain @ (C @ truth - C @ estimate)
        moved[: len(A)] += B @ u
        torch.testing.assert_close(later - moved, matrix @ (truth - estimate))


def test_the_law_keeps_the_limits_without_winding_up(model):
    """Limits that cut the transient, not the steady state."""
    largest = (model.mean[-2:] + torch.tensor([0.51, 0.61]) * model.std[-2:]).tolist()
    lowest = (model.mean[-2:] - torch.tensor([0.41, 0.31]) * model.std[-2:]).tolist()
    actuator = Actuator(low=lowest, high=largest)
    record, steps = closed(model, LatentLaw(model, 1.0, 0.0, 0.2 / STEP), actuator=actuator)
    error = (record.q - record.reference.q).norm(dim=-1)
    assert (error[:, -1] < 1e-3 * steps).all()
    u = record.u.transpose(0, 1)
    low, high = torch.tensor([lowest, largest]).double()
    at_limits = (u < low + 1e-6) | (u > high - 1e-6)
    assert ((u > low - 1e-6) & (u < high + 1e-6)).all()
    assert at_limits[:20].any()
    assert not at_limits[-1].any()


def test_the_set_point_is_filtered_at_least_at_a_fifth_of_the_rate_of_the_model(model):
    """dq_s/dt = 0.2 / T (q_ref - q_s), also with a slow integral action."""
    law = Pipeline(LatentLaw(model, integral_gain=1e-3), STEP).law
    q, zero = torch.tensor([0.1, -0.2]).double(), torch.zeros(2).double()
    memory = law.start(q, zero, zero)
    target = q + torch.tensor([0.3, 0.1]).double()
    _, after, _ = law.step(q, zero, Motion(target, zero, zero), zero, memory)
    q_s = after.split(law._sizes)[2]
    torch.testing.assert_close(q_s, target + np.exp(-0.2) * (q - target))


def test_a_part_of_a_period_of_dead_time_takes_a_part_of_two_inputs(model):
    """The state moves by 0.7 of the second last input and 0.3 of the last one."""
    q, zero = torch.tensor([0.1, -0.2]).double(), torch.zeros(2).double()
    older, newer = torch.tensor([[0.5, -1.0], [-0.7, 0.4]]).double()
    law = Pipeline(LatentLaw(model, dead_time=0.7 * STEP), STEP).law
    memory = law.start(q, zero, older)
    x, d = memory.split(law._sizes)[:2]
    moved, _ = law._observed(q, x, d, torch.stack([older, newer]))
    A, B = model.flow()
    u = 0.7 * older + 0.3 * newer
    n = len(model.bias)
    expected = A @ x + B @ (model.latent_force(u) - model.coupling_force(x[:n]))
    r = (q - model.observe(expected) - d) / model.std[:2]
    gain, _ = law.observer_gain(STEP)
    torch.testing.assert_close(moved, expected + gain[: 2 * n] @ r)
    A, B = model.flow(0.7)  # of a period, until the next input acts
    ahead = A @ x + B @ (model.latent_force(newer) - model.coupling_force(x[:n]))
    torch.testing.assert_close(law._predicted(x, torch.stack([older, newer])), ahead)


def test_a_dead_time_of_the_law_is_that_which_is_set(model):
    law = LatentLaw(model, dead_time=0.06)
    assert Pipeline(law, 0.01, dead_time=0.02).law._late == 0.06
    assert Pipeline(LatentLaw(model), 0.01, dead_time=0.02).law._late == 0.02
    assert Pipeline(LatentLaw(model), 0.01).law._late == 0.0


def test_pid_of_motors_uses_the_static_gain_of_the_model():
    """The exact gain: without feedback of v, the input at rest gives q_ref in one integration."""
    system = LinearSystem(
        mass=[[1.0, 0.2], [0.2, 0.7]],
        stiffness=[[9.0, -2.0], [-2.0, 5.0]],
        damping=[[0.4, 0.1], [0.1, 0.3]],
        inputs=[[1.0, 0.5], [-0.5, 2.0]],
    ).requires_grad_(False)
    pid = MotorPID(system, 1.0, 0.0, 2.0)
    q, zero = torch.tensor([0.1, -0.2]).double(), torch.zeros(2).double()
    reference = SetPoint([0.3, 0.1])(0.0)
    pipeline = Pipeline(pid, 0.5)
    first, _, memory = pipeline(q, zero, *reference, torch.zeros(pipeline.memory_size).double())
    second, _, _ = pipeline(q, zero, *reference, memory)
    typical = system.typical_input(q)
    expected = system.potential_force(q + (reference.q - q)) - system.potential_force(q)
    applied = system.input_matrix(q) @ (first - typical)
    torch.testing.assert_close(applied, expected)
    torch.testing.assert_close(second - typical, 2 * (first - typical))
