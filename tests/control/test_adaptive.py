"""Adaptation of a payload and of friction, against the Lyapunov function and the informed law."""

from pathlib import Path

import numpy as np
import pytest
import torch

from pinn_dyn.control import Actuator, AdaptiveTracking, Motion, Pipeline, Sines
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.systems import RigidChain, SoftArm
from pinn_dyn.testing import ControllerContract
from pinn_dyn.testing.controller import input_of
from tests.support.known import statistics
from tests.support.rigid_chains import TREE

PENDULUM = str(Path(__file__).parents[2] / "examples" / "double_pendulum.urdf")
LOAD = 0.3  # kg; the links have 0.5 kg each
PERIOD, NOISE = 4e-3, (2e-4, 2e-3)
REFERENCE = Sines([0.5, 0.4], [0.6, 0.5], [0.6, 1.0])
GAINS = 8.0, 1.0


def pendulum(**settings):
    return RigidChain(PENDULUM, **{"damping": 0.1, **settings})


def loaded(damping=0.1):
    """The pendulum with a point mass at the end of its second link."""
    arm = pendulum(damping=damping)
    with torch.no_grad():
        point = torch.tensor([0.0, 0.0, -0.2, 1.0]).double()
        arm.inertia[1] += LOAD * point[:, None] * point
    return arm


def advanced(plant, q, v, u):
    """The state after a period with u held, by one step of RK4."""
    x, h = torch.cat([q, v], dim=-1), PERIOD
    a = plant.velocity_derivative(x, u)
    b = plant.velocity_derivative(x + h / 2 * a, u)
    c = plant.velocity_derivative(x + h / 2 * b, u)
    d = plant.velocity_derivative(x + h * c, u)
    return (x + h / 6 * (a + 2 * b + 2 * c + d)).chunk(2, dim=-1)


def follow(law, plant, seconds, start=0.0, state=None, noise=(0.0, 0.0)):
    """q, v, constants and goal of a loop that goes on with a state and a memory, and its end."""
    motion, generator = REFERENCE(start), torch.Generator().manual_seed(round(start))
    pipeline = Pipeline(law, PERIOD)
    memory = torch.zeros(1, pipeline.memory_size).double()
    q, v, memory = state or (motion.q[None].clone(), motion.v[None].clone(), memory)
    rows = []
    for k in range(round(seconds / PERIOD)):
        t = start + k * PERIOD
        motion = REFERENCE(t)
        measured = [
            x + y * torch.randn(x.shape, generator=generator)
            for x, y in zip((q, v), noise, strict=True)
        ]
        u, _, memory = pipeline(*measured, *(x[None] for x in motion), memory)
        rows.append((q[0], v[0], constants_of(law, memory)[0], motion.q))
        with torch.no_grad():
            q, v = advanced(plant, q, v, u)
    return [torch.stack(x) for x in zip(*rows, strict=True)], (q, v, memory)


def constants_of(law, memory):
    """The constants of the latest call, after the mark and the last input."""
    start = 1 + law.num_inputs
    return memory[..., start : start + law.constants_size]


def errors(columns):
    return (columns[0] - columns[3]).square().sum(-1).sqrt().numpy()


@pytest.fixture(scope="module")
def picked_up():
    """Errors of the laws that do not adapt, adapt, and know the load, which comes at 0.5 s."""
    results = {}
    for name, model, rate in (
        ("fixed", pendulum(), 1e-9),
        ("adaptive", pendulum(), 60.0),
        ("informed", None, 1e-9),
    ):
        law = AdaptiveTracking(model or pendulum(), *GAINS, rate=rate, adapt=["payload"])
        before, state = follow(law, pendulum(), 0.5, noise=NOISE)
        if model is None:
            law = AdaptiveTracking(loaded(), *GAINS, rate=rate, adapt=["payload"])
        after, _ = follow(law, loaded(), 3.0, 0.5, state, noise=NOISE)
        results[name] = np.concatenate([errors(before), errors(after)])
        results[f"mass {name}"] = float(law._inertia(after[2][-1])[3, 3])
    return results


def rms(values):
    return np.sqrt(np.mean(values**2))


def test_two_seconds_after_a_pick_up_the_error_is_that_of_the_informed_law(picked_up):
    late = slice(round(2.5 / PERIOD), None)
    fixed, adaptive, informed = (
        rms(picked_up[name][late]) for name in ("fixed", "adaptive", "informed")
    )
    assert adaptive < 1.5 * informed
    assert adaptive < 0.02 * fixed
    assert picked_up["mass adaptive"] == pytest.approx(0.5 + LOAD, rel=0.05)


def test_the_law_is_never_worse_than_without_adaptation(picked_up):
    """In any half second: before the load, the noise of both laws; with it, a fifth at most."""
    half = round(0.5 / PERIOD)
    for start in range(0, round(3.5 / PERIOD), half):
        fixed, adaptive = (rms(picked_up[x][start : start + half]) for x in ("fixed", "adaptive"))
        assert adaptive < (1.5 if start < half else 0.2) * fixed, start


class Pulled(RigidChain):
    """The pendulum with constant torques at its joints."""

    torques = torch.tensor([0.2, -0.1], dtype=torch.float64)

    def mass_and_bias(self, q, v):
        mass, bias = super().mass_and_bias(q, v)
        return mass, bias - self.torques


def test_the_lyapunov_function_decreases_by_the_power_of_the_feedback(monkeypatch):
    """A load of 0.3 kg, twice the friction and constant torques, all unknown, without noise.

    It decreases up to the error of the sampled law, which is proportional to the period.
    """
    plant, rises, rate = Pulled(PENDULUM, damping=0.2), [], 20.0
    plant.inertia.copy_(loaded().inertia)
    for period in (1e-3, 5e-4):
        monkeypatch.setattr("tests.control.test_adaptive.PERIOD", period)
        parts = ["payload", "friction", "offset"]
        law = AdaptiveTracking(pendulum(), *GAINS, rate=rate, adapt=parts, offset=0.5)
        (q, v, memory, _), _ = follow(law, plant, 0.5)
        goal = [REFERENCE(period * k) for k in range(len(q))]
        goal_q, goal_v = (torch.stack([getattr(x, name) for x in goal]) for name in "qv")
        s = goal_v + GAINS[0] * (goal_q - q) - v
        kinetic = 0.5 * torch.einsum("ti,tij,tj->t", s, plant.mass_matrix(q), s)
        J, truth = law._inertia(memory), plant.inertia[1]
        trace = torch.linalg.solve(J, truth.expand_as(J)).diagonal(dim1=1, dim2=2).sum(-1)
        bodies = torch.logdet(J) - torch.logdet(truth) + trace - 4
        f, o = memory[:, 10:12].exp(), 0.5 * memory[:, 12:]
        frictions = ((f / 2).log() + 2 / f - 1).sum(-1)
        offsets = ((o - Pulled.torques) ** 2 / (2 * 0.5**2)).sum(-1)
        V = kinetic + (bodies + frictions + offsets) / rate
        rises.append(float(V.diff().max()) / period)
        dissipated = float(period * GAINS[1] * s.square().sum())
        assert dissipated > 0.1 * V[0]
        assert V[0] - V[-1] > 0.98 * dissipated
    assert rises[1] < 0.6 * rises[0]
    assert rises[1] < 0.3 * float(V[0])  # per second


class TestOnThePendulum(ControllerContract):
    @pytest.fixture
    def controller(self):
        everything = ["payload", "friction", "offset"]
        return AdaptiveTracking(pendulum(), *GAINS, rate=5.0, adapt=everything)


def identified():
    """Known mechanics with armatures and dry friction, as a run has them."""
    model = KnownMechanics(
        statistics(4), RigidChain(TREE, locked_joints=["wrist"]), friction=CoulombFriction
    )
    return model.double().requires_grad_(False)


def test_constants_of_the_model_give_the_law_of_slotine_and_li():
    """With w = v and dw/dt = a, the law is the inverse dynamics of the model."""
    model = identified()
    law = AdaptiveTracking(model, 3.0, 2.0)
    generator = torch.Generator().manual_seed(0)
    q, v, a = torch.randn(3, 5, 4, generator=generator).double()
    u = input_of(law, q, v, Motion(q, v, a))
    torch.testing.assert_close(u, model.input_for(q, v, a))
    # Velocities ahead of the reference: C(q, v) w from the Christoffel symbols.
    ahead = Motion(q, v + 1.0, a)
    expected = model.inverse_dynamics(q, 0 * v, a + 3.0) - model.dissipative_force(q, 0 * v)
    expected += (model.coriolis_matrix(q, v) @ (v + 1.0)[..., None])[..., 0]
    expected += model.dissipative_force(q, v + 1.0) + 2.0
    torch.testing.assert_close(
        model.input_matrix(q[0]) @ input_of(law, q, v, ahead)[0], expected[0]
    )


def test_the_payload_adapts_along_the_gradient_of_the_power():
    """dJ/dt = g J S J with tr(S X) = s^T Y(X), of the slope of the torque with the inertia."""
    law = AdaptiveTracking(pendulum(), *GAINS, rate=3.0, adapt=["payload"])
    generator = torch.Generator().manual_seed(0)
    q, v, q_ref, v_ref, a_ref = torch.randn(5, 2, generator=generator).double()
    constants = 0.3 * torch.randn(10, generator=generator).double()
    J, motion = law._inertia(constants), Motion(q_ref, v_ref, a_ref)
    s = v_ref + GAINS[0] * (q_ref - q) - v

    def power(inertia):
        arm = pendulum()
        arm.inertia[1] = inertia
        other = AdaptiveTracking(arm, *GAINS, adapt=["payload"])
        return s @ other._torque(q, v, motion, torch.zeros(10).double())

    # tr(S X) for a basis of the symmetric X, by differences of a linear function.
    S = torch.zeros(4, 4).double()
    for i in range(4):
        for j in range(i + 1):
            X = torch.zeros(4, 4).double()
            X[i, j] = X[j, i] = 1e-6
            slope = (power(J + X) - power(J)) / 1e-6
            S[i, j] = S[j, i] = slope / (1 if i == j else 2)
    B = torch.linalg.cholesky(J)
    found = law.changes(q, v, motion, constants, 0 * q).unflatten(-1, (4, 4))
    torch.testing.assert_close(found, 3.0 * B.T @ S @ B, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(found, found.T)


def test_no_constant_moves_far_in_a_period():
    parts = ["payload", "friction", "offset"]
    law = AdaptiveTracking(pendulum(), *GAINS, rate=1.0, adapt=parts, offset=2.0)
    before = torch.zeros(law.constants_size).double()
    after = law.adapted(before, torch.full((20,), 1e6).double(), PERIOD)
    assert after[10:].tolist() == [0.5] * 4
    X = torch.full((4, 4), 0.125).double()  # of norm 1/2
    one, B = torch.eye(4).double(), torch.linalg.cholesky(law._inertia(before))
    expected = B @ torch.linalg.solve(one - X / 2, one + X / 2) @ B.T
    torch.testing.assert_close(law._inertia(after), expected, rtol=1e-4, atol=1e-8)


def test_limits_of_the_input_are_not_taken_for_a_payload():
    """With an exact model, constants do not move by more than C, which sigma leaves out."""
    arm, moved = pendulum(), {}
    law = AdaptiveTracking(arm, *GAINS, rate=20.0)
    for name in ("sigma", "without"):
        actuator = Actuator(low=-1.5, high=1.5)
        pipeline = Pipeline(law, PERIOD, actuator=actuator)
        q, v = (x[None] for x in REFERENCE(0.0)[:2])
        memory, statuses = torch.zeros(1, pipeline.memory_size).double(), 0
        for k in range(100):
            u, status, memory = pipeline(q, v, *REFERENCE(k * PERIOD), memory)
            statuses += int(status)
            if name == "without":  # as if the wanted input had been applied
                memory[..., -2:] = u
            q, v = advanced(arm, q, v, u)
        assert statuses > 20
        moved[name] = float(constants_of(law, memory).abs().max())
    assert moved["sigma"] < 0.2 * moved["without"]


def test_models_without_bodies_are_refused():
    with pytest.raises(TypeError, match="no rigid chain whose bodies could adapt"):
        AdaptiveTracking(SoftArm(1), 1.0, 1.0)
