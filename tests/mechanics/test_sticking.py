"""Sticking friction: exact rest, order against event-driven solutions, passivity, gradients."""

import itertools
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from pinn_dyn.exports.c_loop import CLoop
from pinn_dyn.mechanics import RK4, Rosenbrock, Signal
from pinn_dyn.mechanics.compilation import integrated_by
from pinn_dyn.mechanics.integrators import Sticking
from pinn_dyn.models import CoulombFriction
from pinn_dyn.run.export import export
from pinn_dyn.testing import LinearSystem, assert_near, partial_derivatives
from tests.support.code_in_c import build_at_once, codes
from tests.support.known import elastic_model, known_model
from tests.support.rigid_chains import TREE

METHODS = [RK4, Rosenbrock]


class Rubbing(LinearSystem):
    """A linear system whose coordinates stick, with the levels c+ and c-."""

    sticking = True

    def __init__(self, forward, backward, mass, stiffness, damping, inputs):
        super().__init__(mass, stiffness, damping, inputs)
        self.forward_level = torch.as_tensor(forward, dtype=torch.float64)
        self.backward_level = torch.as_tensor(backward, dtype=torch.float64)

    def sliding_force(self, v, share):
        return share * self.forward_level - (1 - share) * self.backward_level


def slider():
    """A mass on a spring and a damper."""
    return Rubbing([1.2], [0.9], [[1.3]], [[4.0]], [[0.2]], [[1.0]]).requires_grad_(False)


def two_links():
    """Two coupled inertias like those of an arm."""
    matrices = [[2.0, 0.7], [0.7, 0.5]], [[3.0, 0.4], [0.4, 1.0]], [[0.1, 0.0], [0.0, 0.05]]
    return Rubbing([1.0, 0.6], [0.8, 0.7], *matrices, np.eye(2)).requires_grad_(False)


def drive(t, size):
    """A smooth input that lets the coordinates start, stop and turn."""
    t = np.asarray(t)[..., None]
    return 1.5 * np.sin(2.1 * t + np.arange(size)) + 0.5 * np.sin(5.3 * t)


def event_driven(system, x0, times):
    """Solve the inclusion by SciPy between stops and starts, found as events.

    At an event all combinations of directions are tried: the one that Coulomb's law allows holds.
    """
    n = system.num_coordinates
    mass, stiffness, damping = (x.numpy() for x in (system.mass, system.stiffness, system.damping))
    levels = system.forward_level.numpy(), system.backward_level.numpy()

    def motion(t, x, mode):
        """Return the acceleration and the friction."""
        q, v = x[:n], x[n:]
        force = drive(t, n) - stiffness @ q - damping @ v
        friction = np.where(mode > 0, levels[0], np.where(mode < 0, -levels[1], 0.0))
        free = mode != 0
        a = np.zeros(n)
        a[free] = np.linalg.solve(mass[np.ix_(free, free)], (force - friction)[free])
        return a, np.where(free, friction, force - mass @ a)

    def allowed(t, x, moving):
        for mode in itertools.product((0, 1, -1), repeat=n):
            mode = np.array(mode)
            if ((moving != 0) & (mode != moving)).any():
                continue
            a, friction = motion(t, x, mode)
            held = (friction <= levels[0] + 1e-12) & (friction >= -levels[1] - 1e-12)
            if np.where(mode == 0, held, (moving != 0) | (a * mode > 0)).all():
                return mode
        raise AssertionError("no mode is allowed")

    def limits(t, x, mode, k):
        if mode[k]:
            return mode[k] * x[n + k]
        friction = motion(t, x, mode)[1][k]
        return min(levels[0][k] - friction, friction + levels[1][k])

    t, x = 0.0, np.array(x0, dtype=float)
    states = [x]
    mode = allowed(t, x, np.sign(x[n:]).astype(int))
    for end in times[1:]:
        while t < end:
            events = [partial(lambda t, x, mode, k: limits(t, x, mode, k), k=k) for k in range(n)]
            for event in events:
                event.terminal, event.direction = True, -1
            solution = solve_ivp(
                lambda t, x, mode: np.concatenate([x[n:], motion(t, x, mode)[0]]),
                (t, end), x, args=(mode,), events=events, rtol=1e-11, atol=1e-12, max_step=0.05,
            )  # fmt: skip
            t, x = solution.t[-1], solution.y[:, -1].copy()
            if solution.status == 1:
                (k,) = (k for k in range(n) if len(solution.t_events[k]))
                moving = np.where(np.arange(n) == k, 0, mode)
                x[n + k] = 0.0
                mode = allowed(t + 1e-9, x, moving)
        states.append(x)
    return np.array(states)


def predicted(system, method, x0, t, substeps=1):
    system.integrator = Sticking(method(substeps))
    fine = torch.linspace(0, float(t[-1]), 40 * (len(t) - 1) + 1, dtype=torch.float64)
    u = torch.from_numpy(drive(fine.numpy(), system.num_inputs)).expand(len(x0), -1, -1)
    with torch.no_grad():
        return system.predict(x0, t, Signal(fine, u, "cubic"))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("build", "order"), [(slider, 2), (two_links, 1)])
def test_order_against_an_event_driven_solution(build, order, method):
    """Coordinates stop, stick, start and turn within the steps, and start each other."""
    system = build()
    n = system.num_coordinates
    starts = torch.randn(6, 2 * n, generator=torch.Generator().manual_seed(0)).double()
    t = torch.linspace(0, 6, 31, dtype=torch.float64)
    references = [event_driven(system, x0.numpy(), t.numpy()) for x0 in starts]
    expected = torch.from_numpy(np.stack(references))
    assert (expected[..., n:] == 0).any()
    coarse, fine = (predicted(system, method, starts, t, k) - expected for k in (2, 16))
    assert float(fine.square().mean().sqrt()) < 2 / 8**order * float(coarse.square().mean().sqrt())
    assert float(fine.square().mean().sqrt()) < 1e-3


def pushed(damping, method, h, u, v0=0.0, friction=None, stride=1):
    """States of a mass of 1 kg with a friction level of 1 N, at each ``stride``-th input."""
    system = Rubbing([1.0], [1.0], [[1.0]], [[0.0]], [[damping]], [[1.0]]).requires_grad_(False)
    system.sliding_force = friction or system.sliding_force
    system.integrator = Sticking(method())
    t = h * torch.arange(len(u), dtype=torch.float64)
    signal = Signal(t, torch.tensor(u, dtype=torch.float64)[:, None])
    return system.predict(torch.tensor([0.0, v0], dtype=torch.float64), t[::stride], signal)


def test_a_strongly_damped_mass_comes_to_rest_and_stays_there():
    """An implicit step is longer than the time constant M/D of 20 ms."""
    q, v = pushed(50.0, Rosenbrock, 0.02, [0.0] * 12, v0=10.0).unbind(-1)
    stop = np.log(1 + 10.0 * 50) / 50
    assert float(q[-1]) == pytest.approx(10.0 / 50 - stop / 50, rel=0.02)
    assert (v[:6] > 0).all()
    assert not v[8:].any()
    assert q.diff().min() > -1e-5  # a step may end beyond the stop
    assert not pushed(50.0, Rosenbrock, 0.1, [0.0] * 3, v0=0.09)[1:, 1].any()


@pytest.mark.parametrize("method", METHODS)
def test_a_mass_that_turns_within_a_step_moves_back_for_the_rest_of_it(method):
    """The force of -3 N stops it after 25 ms of 0.1 s, against friction of 1 N."""
    q, v = pushed(0.0, method, 0.1, [-3.0, -3.0], v0=0.1)[1]
    assert float(v) == pytest.approx(-2.0 * 0.075)
    assert float(q) == pytest.approx(0.1 * 0.025 / 2 - 2.0 * 0.075**2 / 2)


def test_a_stopped_mass_is_held_by_the_friction_at_rest():
    """The load of 1.5 N is above the sliding friction of 1 N, and below the stiction of 2 N."""

    def stribeck(v, share):
        return (2 * share - 1) * (1 + torch.exp(-((v / 0.01) ** 2)))

    q, v = pushed(0.0, RK4, 0.05, [-1.5] * 5, v0=0.05, friction=stribeck).unbind(-1)
    assert not v[1:].any()
    assert float(q[-1]) == pytest.approx(0.05**2 / (2 * 2.5), rel=0.3)


@pytest.mark.parametrize("method", METHODS)
def test_a_load_that_grows_beyond_the_friction_within_a_step_moves_the_mass(method):
    start = (1.0 - 0.9) / 6.0  # 6 N/s
    v = pushed(0.0, method, 0.1, [0.9, 1.5])[-1, 1]
    assert float(v) == pytest.approx(3 * (0.1 - start) ** 2, rel=0.1)
    assert not pushed(0.0, method, 0.1, [1.1, 0.5])[-1].any()


def test_a_push_between_the_ends_of_a_step_moves_the_mass():
    """The mean input is 1.2 N."""
    v = pushed(0.0, Rosenbrock, 0.02, [0.0, 0.0, 3.0, 3.0, 0.0, 0.0], stride=5)[-1, 1]
    assert float(v) == pytest.approx(0.02)


def test_coordinates_that_start_from_rest_obey_the_law_of_coulomb():
    """Loads on four coupled inertias: each holds below its level, or moves against it."""
    inertia = torch.tensor([[4.0, 1.5, 0.6, 0.2], [1.5, 2.0, 0.7, 0.3], [0.6, 0.7, 0.9, 0.3]])
    mass = torch.cat([inertia, torch.tensor([[0.2, 0.3, 0.3, 0.4]])])
    level = [1.0, 0.8, 0.5, 0.2]
    system = Rubbing(level, level, mass, *2 * [torch.zeros(4, 4)], torch.eye(4))
    system.integrator = Sticking(RK4())
    generator = torch.Generator().manual_seed(0)
    force = 1.5 * torch.randn(500, 4, generator=generator).double() * system.forward_level
    t = torch.tensor([0.0, 0.01], dtype=torch.float64)
    signal = Signal(t, force[:, None].expand(500, 2, 4))
    with torch.no_grad():
        end = system.predict(torch.zeros(500, 8).double(), t, signal)
    a = end[:, 1, 4:] / 0.01
    friction = force - a @ system.mass
    assert 0.2 < float((a == 0).double().mean()) < 0.8
    assert (friction.abs() <= system.forward_level * (1 + 1e-9)).all()
    moving = a.sign() * system.forward_level
    torch.testing.assert_close(friction[a != 0], moving[a != 0])


@pytest.mark.parametrize("method", METHODS)
def test_without_friction_a_step_is_that_of_the_inner_method(method):
    """Stiff springs and dampers, in states whose velocities keep their signs."""
    system = two_links()
    system.forward_level, system.backward_level = torch.zeros(2, 2, dtype=torch.float64)
    system.stiffness_matrix = lambda q: system.stiffness
    x0 = torch.tensor([[0.01, -0.02, 3.0, 2.0], [0.0, 0.01, -2.0, 4.0]], dtype=torch.float64)
    t = torch.tensor([0.0, 0.3], dtype=torch.float64)
    signal = Signal(t, torch.tensor([[1.0, 0.3], [0.5, 0.8]]).double().expand(2, 2, 2))
    ends = []
    for system.integrator in (Sticking(method()), method()):
        ends.append(system.predict(x0, t, signal)[:, 1])
    torch.testing.assert_close(*ends, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("method", METHODS)
def test_rest_is_exact(method, dtype):
    """Loads below the friction level move nothing, to the last bit; above, one link moves."""
    system = two_links().to(dtype)
    system.forward_level, system.backward_level = torch.ones(2, 2, dtype=dtype)
    system.integrator = Sticking(method())
    t = 0.01 * torch.arange(60, dtype=torch.float64)
    x0 = torch.tensor([0.13, -0.31, 0.0, 0.0], dtype=dtype)
    load = torch.stack([0.9 * torch.sin(9 * t), 0.9 * torch.cos(7 * t)], -1) + x0[:2] @ (
        system.stiffness.double().to(dtype)
    )
    path = system.increments(x0, t, Signal(t, load.to(dtype)))
    assert not path.any()
    pushed = torch.where(t[:, None] > 0.3, load + torch.tensor([0.0, 2.0]), load).to(dtype)
    path = system.increments(x0, t, Signal(t, pushed))
    assert not path[:30].any()
    assert path[-1].any()


@pytest.mark.parametrize("elastic", [False, True])
def test_friction_never_adds_energy(elastic):
    """Free motions of arms lose energy in each step."""
    model = elastic_model(friction=CoulombFriction) if elastic else known_model()
    assert isinstance(model.integrator, Sticking)
    n = model.num_coordinates
    with torch.no_grad():
        model.friction.level.z += 1.0
        generator = torch.Generator().manual_seed(0)
        x0 = torch.randn(20, 2 * n, generator=generator, dtype=torch.float64)
        x0[:, n:] *= 0.3
        t = 0.005 * torch.arange(200, dtype=torch.float64)
        signal = Signal(t, torch.zeros(20, 200, model.num_inputs, dtype=torch.float64))
        q, v = model.predict(x0, t, signal).chunk(2, dim=-1)
        energy = model.total_energy(q, v)
    scale = (energy[:, :1] - energy[:, -1:]).abs()
    assert ((energy.diff(dim=1) / scale) < 1e-9).all()


def test_loops_and_batches_equal_single_steps(monkeypatch, tmp_path):
    build_at_once(monkeypatch, tmp_path)
    system = two_links()
    t = torch.linspace(0, 3, 20, dtype=torch.float64)
    x0 = torch.tensor([[0.0, 0.0, 0.7, -0.4], [0.1, 0.0, 0.0, 0.0]], dtype=torch.float64)
    u = torch.from_numpy(drive(t.numpy(), 2))
    both = Signal(t, torch.stack([u, -u]))
    system.integrator = Sticking(RK4())
    with torch.no_grad():
        expected = system.predict(x0, t, both)
        for k, sign in enumerate((1, -1)):
            alone = system.predict(x0[k], t, Signal(t, sign * u))
            torch.testing.assert_close(alone, expected[k], rtol=0, atol=1e-12)
        with integrated_by(system, CLoop(system.integrator)):
            path = system.predict(x0, t, both)
        torch.testing.assert_close(path, expected, rtol=0, atol=1e-12)
    assert len(codes()) == 1


@pytest.mark.parametrize("method", METHODS)
def test_gradients_of_motions_with_stops_match_finite_differences(method):
    system = two_links()
    system.integrator = Sticking(method())
    t = torch.linspace(0, 2, 41, dtype=torch.float64)

    def end(x):
        system.forward_level = x[..., :2]
        start = torch.cat([torch.zeros_like(x[..., :2]), x[..., 2:]], dim=-1)
        u = torch.from_numpy(drive(t.numpy(), 2)).expand(*x.shape[:-1], 41, 2)
        states = system.increments(start, t, Signal(t, u))
        stopped.append((states[..., 2:] + start[..., None, 2:] == 0).any())
        return states[..., -1, :].square().sum(-1)

    stopped = []
    x = torch.tensor([1.0, 0.6, 0.7, -0.4], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(end(x), x)
    assert_near(gradient, partial_derivatives(end, x.detach(), 1e-5), 1e-6)
    assert stopped[0]


def test_small_steps_approach_the_friction_loss_of_mujoco():
    """An arm with friction loss, whose joints stick by turns, beside MuJoCo's hard limit."""
    mujoco = pytest.importorskip("mujoco")
    model = known_model(TREE, friction=CoulombFriction, start="prior")
    with torch.no_grad():
        model.friction.level.z += 1.5
    model.requires_grad_(False)
    n = model.num_coordinates
    t = torch.linspace(0, 1.5, 301, dtype=torch.float64)
    u = 3.0 * torch.from_numpy(drive(t.numpy(), n))
    x0 = torch.zeros(2 * n, dtype=torch.float64)
    path = model.predict(x0, t, Signal(t, u, "hold")).numpy()
    assert 0.05 < float((path[:, n:] == 0).mean()) < 0.9
    with tempfile.TemporaryDirectory() as folder:
        file = export(model, Path(folder) / "arm.xml")
        robot = mujoco.MjModel.from_xml_path(str(file))
    robot.opt.timestep, robot.opt.integrator = 5e-4, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    robot.dof_solref[:], robot.dof_solimp[:] = (1e-3, 1), (0.999, 0.9999, 1e-3, 0.5, 2)
    robot.jnt_limited[:] = 0
    state = mujoco.MjData(robot)
    joints = [robot.joint(name).qposadr[0] for name in model.structure.joint_names]
    states = []
    for force in u.numpy():
        states.append(state.qpos[joints].copy())
        state.ctrl[:] = force
        for _ in range(10):
            mujoco.mj_step(robot, state)
    error = np.abs(path[:, :n] - np.array(states)).max()
    assert error < 1e-3 * np.abs(path[:, :n]).max()
