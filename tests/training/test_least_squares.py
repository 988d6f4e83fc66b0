"""Least squares finds the constants that made the data, and leaves what no data determine."""

import dataclasses
import itertools
from functools import partial

import numpy as np
import pytest
import torch
from scipy.signal import lfilter
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from pinn_dyn.data.windows import draw_windows
from pinn_dyn.identification.constants import constants_table
from pinn_dyn.mechanics import MechanicalSystem, Signal, Trajectory
from pinn_dyn.models import CoulombFriction, KnownSystem
from pinn_dyn.training import LeastSquares, least_squares
from pinn_dyn.training.constants_fit import Fit, Prior, left_out
from pinn_dyn.training.filtered_motion import filtered_motion
from tests.support.known import known_model, motion, motions, statistics
from tests.support.rigid_chains import joint, link, robot

PENDULUM = robot(
    link("base"),
    link("rod", 2.0),
    link("tip", 0.5),
    joint("swing", "revolute", "base", "rod", rpy="0 0 0", axis="0 1 0"),
    joint("bend", "revolute", "rod", "tip", rpy="0 0 0", axis="0 1 0"),
)


def robot_model(start, seed=None, sticking=False):
    friction = partial(CoulombFriction, sticking=sticking)
    model = known_model(PENDULUM, locked_joints=(), friction=friction, start=start)
    if seed is not None:
        generator = torch.Generator().manual_seed(seed)
        for parameter in model.parameters():
            torch.nn.init.normal_(parameter, std=0.5, generator=generator)
    return model


@pytest.fixture(scope="module")
def truth():
    return robot_model("prior", seed=1)


@pytest.fixture(scope="module")
def runs(truth):
    return motions(truth, range(2), seconds=3.0, rate=100.0)


@pytest.fixture(scope="module")
def unseen(truth):
    """Another motion."""
    return motion(truth, seconds=1.0, rate=100.0, seed=9)


def held_out_error(model, truth, run):
    """Of the acceleration, as a share of its spread, at the states of a motion."""
    with torch.no_grad():
        a, expected = (m.forward_dynamics(run.q, run.v, run.u) for m in (model, truth))
    return float((a - expected).norm() / expected.norm())


def test_rollouts_fit_friction_that_sticks():
    """A load below the friction level holds; only rollouts that stick fit such windows."""
    truth = robot_model("prior", seed=1, sticking=True)
    with torch.no_grad():
        truth.friction.level.z += 1.5
    runs = motions(truth, range(2), seconds=3.0, rate=100.0)
    assert float((runs[0].v == 0).double().mean()) > 0.03
    windows = draw_windows(runs, count=30, steps=2, stride=4, seed=0)
    model = robot_model("prior", sticking=True)
    result = LeastSquares(cutoff=20.0, evaluations=6).fit(model, runs, windows)
    ratio = model.friction.level() / truth.friction.level()
    assert result.residual < 0.05  # 0.2 with the smooth law
    assert float(ratio.log().abs().max()) < 0.05  # 0.6 with the smooth law


@pytest.fixture(scope="module")
def identified(runs):
    """A model that was fitted by inverse dynamics alone, and its fit."""
    model = robot_model("generic")
    return model, LeastSquares(cutoff=20.0, rollouts=False).fit(model, runs)


@pytest.fixture(scope="module")
def rolled_out(truth, runs, unseen):
    """A model whose rollouts validate better, and its fit."""
    windows = draw_windows(runs, count=40, steps=2, stride=2, seed=0)
    model = robot_model("generic")
    fit = LeastSquares(cutoff=20.0).fit(
        model,
        runs,
        windows,
        validate=lambda model: torch.tensor([held_out_error(model, truth, unseen)]),
    )
    return model, fit


@pytest.mark.parametrize("rollouts", [False, True], ids=["identification", "rollouts"])
def test_the_dynamics_are_found_from_a_generic_start(request, truth, unseen, rollouts):
    model, result = request.getfixturevalue("rolled_out" if rollouts else "identified")
    assert result.stage == ("rollouts of 0.04 s" if rollouts else "inverse dynamics")
    assert held_out_error(robot_model("generic"), truth, unseen) > 0.3
    assert held_out_error(model, truth, unseen) < (0.01 if rollouts else 0.05)
    assert result.residual < (0.001 if rollouts else 0.05)
    # The base parameters of a planar chain are fewer than ten for each body: the rest is held by
    # the prior, and says so.
    assert torch.linalg.eigvalsh(result.information).min() < 0.1
    assert torch.linalg.eigvalsh(result.covariance).max() <= 1.001
    assert torch.linalg.eigvalsh(result.covariance).min() > 0


def test_a_fit_that_knew_much_for_certain_can_be_started_from(runs):
    """Standard deviations from 1e-7 of the prior's to all of it, in directions across bodies."""
    model = robot_model("generic")
    count = sum(p.numel() for p in model.parameters())
    generator = torch.Generator().manual_seed(0)
    basis, _ = torch.linalg.qr(torch.randn(count, count, generator=generator).double())
    covariance = basis @ torch.diag(torch.logspace(-14, 0, count).double()) @ basis.mT
    covariance = (covariance + covariance.mT) / 2
    windows = draw_windows(runs, count=4, steps=1, stride=1, seed=0)
    solver = LeastSquares(cutoff=20.0, rollouts=False, changed=["tip"], evaluations=2)
    root = solver.fit(model, runs, windows, covariance).prior.root
    held = torch.tensor([not name.endswith(" of tip") for name in model.parameter_names()])
    known = covariance[held][:, held]
    # R^T R is the inverse of what is known: |R x| is the length of x in standard deviations.
    x = torch.linalg.cholesky(known)
    lengths = (root[:, held] @ x).norm(dim=0)
    torch.testing.assert_close(lengths, torch.ones_like(lengths), rtol=1e-3, atol=0)
    # A heavy load is five standard deviations of the usual prior.
    free = root[:, ~held].norm(dim=0)
    torch.testing.assert_close(free, torch.full_like(free, 1 / 5), rtol=1e-9, atol=0)


def test_the_information_is_that_of_the_inputs_that_are_missed(truth, runs):
    """Gauss-Newton's matrix, by central differences of r = k^-1 (M a + ... - o) - u."""
    model = known_model(PENDULUM, locked_joints=(), friction=CoulombFriction, gain_spread=0.3)
    found = LeastSquares(cutoff=20.0, rollouts=False, samples=100).fit(model, runs, None)
    q, v, a, u = filtered_motion(runs, 20.0, 100)
    moves = v.abs() > 0.05 * v.std(0)  # at rest dry friction may have any value

    def missed(z):
        vector_to_parameters(z, model.parameters())
        wanted = model.inverse_dynamics(q, v, a) / model.drive_gain()
        return ((wanted - u) / u.std(0))[moves]

    with torch.no_grad():
        z = parameters_to_vector(model.parameters())
        steps = 1e-5 * torch.eye(len(z), dtype=torch.float64)
        slopes = torch.stack([(missed(z + s) - missed(z - s)) / 2e-5 for s in steps], dim=-1)
    expected = slopes.T @ slopes
    share = found.information.trace() / expected.trace()  # of the noise
    torch.testing.assert_close(found.information, share * expected, rtol=1e-4, atol=1e-4 * share)


class Pendulum(MechanicalSystem):
    """A pendulum with viscous friction, known but for three constants."""

    def __init__(self):
        super().__init__(1, 1)
        self.constants = {"inertia": ["kg m^2"], "weight": ["Nm"], "friction": ["Nms/rad"]}
        for name, value in (("inertia", 1.0), ("weight", 5.0), ("friction", 0.5)):
            self.register_buffer(name, torch.tensor([value]))

    def mass_matrix(self, q):
        return (self.inertia * torch.ones_like(q)).unsqueeze(-1)

    def potential_energy(self, q):
        return self.weight * (1 - torch.cos(q[..., 0]))

    def damping_matrix(self, q):
        return (self.friction * torch.ones_like(q)).unsqueeze(-1)

    def input_matrix(self, q):
        return torch.ones_like(q).unsqueeze(-1)


@pytest.mark.parametrize("error", ["correlated noise", "drag"])
def test_intervals_hold_the_truth_under_errors_that_repeat(error):
    """Errors are about as large as their standard deviations; the seeds are fixed."""
    t = torch.arange(1001, dtype=torch.float64)[:, None] / 100
    deviations = []
    for seed in range(8):
        generator = np.random.default_rng(seed)
        q = v = a = torch.zeros_like(t)
        for frequency in 2 * np.pi * np.array([0.2, 0.37, 0.61, 1.1]):
            angle = frequency * t + generator.uniform(0, 6)
            size = generator.uniform(0.3, 1) / frequency**0.5
            q, v = q + size * angle.sin(), v + size * frequency * angle.cos()
            a = a - size * frequency**2 * angle.sin()
        u = a + 5 * q.sin() + 0.5 * v
        if error == "drag":
            u = u + 0.1 * v * v.abs() - 0.2 * v  # 0.2 v is the linear part of the drag
        else:
            white = torch.from_numpy(generator.normal(size=t.shape))
            u = u + 0.1 * torch.from_numpy(lfilter([1], [1, -0.95], white, axis=0))
        model = KnownSystem(dataclasses.replace(statistics(1), u_std=u.std(0)), Pendulum()).double()
        for part in model.learned.values():
            part.start *= 2
        run = Trajectory(q, v, Signal(t[:, 0], u))
        table = constants_table(model, LeastSquares(cutoff=6.0, rollouts=False).fit(model, [run]))
        deviations.append((table.value - [1.0, 5.0, 0.5]) / ((table.high - table.value) / 1.96))
    size = np.abs(deviations).mean(0)
    # The mean of a standard normal magnitude is 0.8.
    assert (size < 1.5).all()
    assert size.max() > 0.4


def test_every_signal_passes_the_same_filter():
    """A linear law holds for filtered motion only if q, v and u are filtered alike."""
    t = torch.arange(1000, dtype=torch.float64)[:, None] / 200
    slow, noise = torch.sin(2 * torch.pi * t), torch.sin(2 * torch.pi * 60 * t)
    noisy = slow + noise
    run = Trajectory(noisy, noisy, Signal(t[:, 0], noisy))
    q, v, _, u = filtered_motion([run], 10.0, samples=1000)
    edge = (len(t) - len(q)) // 2
    for smooth in (q, v, u):
        error = (smooth - slow[edge:-edge])[100:-100]
        assert float(error.abs().max()) < 0.01


def test_the_stage_that_validates_best_is_kept(truth, runs, unseen, identified):
    """Windows that start at wrong velocities spoil the rollouts, not the identification."""
    windows = draw_windows(runs, count=20, steps=4, stride=1, seed=0)
    noise = torch.randn(windows.v.shape, generator=torch.Generator().manual_seed(0)).double()
    windows = dataclasses.replace(windows, v=windows.v + 0.5 * noise)
    errors, kept = [], []

    def validate(model):
        errors.append(held_out_error(model, truth, unseen))
        if len(errors) == 3:
            raise KeyboardInterrupt
        return torch.tensor([errors[-1]])

    model, solver = robot_model("generic"), LeastSquares(cutoff=20.0)
    alone, expected = identified
    with pytest.raises(KeyboardInterrupt):
        solver.fit(model, runs, windows, validate=validate, keep=kept.append)
    stopped = Fit.from_state(kept[-1].state(), sum(p.numel() for p in model.parameters()))
    result = solver.fit(model, runs, windows, stopped=stopped, validate=validate)
    assert len(errors) == 4
    assert errors[-1] > 2 * errors[0]
    assert (result.stage, result.stopped_in) == ("inverse dynamics", None)
    assert held_out_error(model, truth, unseen) == pytest.approx(errors[0])
    assert errors[0] == pytest.approx(held_out_error(alone, truth, unseen))
    torch.testing.assert_close(result.covariance, expected.covariance)


@pytest.mark.parametrize(
    ("changes", "stage"),
    [
        ([[0.1, -0.2, 0.3, -0.1], [0.1, -0.2, 0.2, 0.1]], 2),  # larger by less than the noise
        ([[0.1, 0.1, 0.1, 0.12], [0.3, 0.3, 0.3, 0.3]], 0),  # larger in each part
        ([[-0.3] * 4, [-0.2, -0.2, -0.2, -0.3]], 1),  # better than the first, not the second
        ([[-0.1, 9.0, -0.1, -0.1], [0.1, -0.1, 0.0, 0.1]], 2),  # a part diverged in the second
        ([[0.1, 0.0, -0.1, 0.1], [0.2, -0.2, 0.0, 9.0]], 1),
    ],
)
def test_a_later_stage_is_kept_unless_it_is_clearly_worse(runs, monkeypatch, changes, stage):
    windows = draw_windows(runs, count=20, steps=4, stride=1, seed=0)
    number = itertools.count()

    def solved(self, name, model, *others, **settings):
        with torch.no_grad():
            next(model.parameters()).fill_(next(number))
        z = parameters_to_vector(model.parameters()).detach()
        eye = torch.eye(len(z)).to(z)
        return Fit(eye, eye, Prior(0 * z, eye), 0.1, 1, z=z.clone())

    monkeypatch.setattr(LeastSquares, "_solve", solved)
    errors = iter([torch.ones(4), *(1 + torch.tensor(x) for x in changes)])
    model = robot_model("prior")
    LeastSquares(cutoff=20.0).fit(model, runs, windows, validate=lambda _: next(errors))
    assert float(next(model.parameters()).detach().flatten()[0]) == stage


def test_the_fit_without_a_run_is_exact_for_a_linear_model(runs):
    """Windows know their run by their start, and a linear fit needs no second one."""
    parts = [draw_windows([run], count=8, steps=2, stride=2, seed=0) for run in runs]
    blocks = torch.cat([least_squares._runs_of(windows, runs) for windows in parts])
    generator = torch.Generator().manual_seed(0)
    slopes = torch.randn(len(blocks), 3, generator=generator, dtype=torch.float64)
    data = torch.randn(len(blocks), generator=generator, dtype=torch.float64)
    root = torch.eye(3, dtype=torch.float64)

    def minimum(rows):
        system, target = torch.cat([slopes[rows], root]), torch.cat([data[rows], torch.zeros(3)])
        return torch.linalg.lstsq(system, target).solution

    z = minimum(slice(None))
    parts = [blocks == number for number in range(2)]
    fits = left_out(z, slopes, slopes @ z - data, parts, root)
    torch.testing.assert_close(fits, torch.stack([minimum(slice(8, 16)), minimum(slice(0, 8))]))
