"""Known mechanics of an Acrobot, whose shoulder has no motor, against equations of its own."""

import copy
import itertools

import numpy as np
import pytest
import torch
from scipy.signal import butter, sosfiltfilt

from pinn_dyn.control.laws import Regulation
from pinn_dyn.control.stability import certify
from pinn_dyn.data import draw_windows
from pinn_dyn.evaluation.identification import constants_table, undetermined
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.models.learned_constants import Slopes
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares
from tests.support.rigid_chains import joint, link, robot

URDF = robot(
    link("base"),
    link("upper", 1.0),
    link("lower", 1.0),
    joint("shoulder", "continuous", "base", "upper", xyz="0 0 0", rpy="0 0 0", axis="0 1 0"),
    joint("elbow", "continuous", "upper", "lower", xyz="0 0 -0.5", rpy="0 0 0", axis="0 1 0"),
)
# Rods of 0.5 m: (1.0 kg, 0.8 kg), centres at half their lengths.
UPPER, LOWER, COUPLING = 1.0 * 0.5**2 / 3 + 0.8 * 0.5**2, 0.8 * 0.5**2 / 3, 0.8 * 0.5 * 0.25
WEIGHTS = 9.81 * np.array([1.0 * 0.25 + 0.8 * 0.5, 0.8 * 0.25])
VISCOUS, DRY, WIDTH = np.array([0.01, 0.05]), np.array([0.05, 0.2]), 0.05
TRUTH = np.r_[UPPER, LOWER, COUPLING, WEIGHTS, VISCOUS, DRY]
RATE, SECONDS = 200, 6


def columns(q, v, a):
    """The force is linear in the nine constants: columns ``(T, 2, 9)``."""
    q1, q2, (v1, v2), (a1, a2), zero = q[:, 0], q[:, 1], v.T, a.T, 0 * q[:, 0]
    shoulder = np.cos(q2) * (2 * a1 + a2) - np.sin(q2) * (2 * v1 * v2 + v2**2)
    elbow = np.cos(q2) * a1 + np.sin(q2) * v1**2
    both = a1 + a2
    sign = np.tanh(v / WIDTH).T
    rows = [
        [a1, both, shoulder, np.sin(q1), np.sin(q1 + q2), v1, zero, sign[0], zero],
        [zero, both, elbow, zero, np.sin(q1 + q2), zero, v2, zero, sign[1]],
    ]
    return np.array(rows).transpose(2, 0, 1)


def acceleration(constants, q, v, u):
    zero = 0 * q
    still = columns(q, zero, zero) @ constants
    mass = [columns(q, zero, zero + row) @ constants - still for row in np.eye(2)]
    force = np.stack([0 * u, u], axis=-1) - columns(q, v, zero) @ constants
    return np.linalg.solve(np.stack(mass, axis=-1), force[..., None])[..., 0]


def simulated(constants, start, u, steps=2):
    """The states ``(T, K, 4)`` of K motions by Runge-Kutta under linear inputs ``(T, K)``."""
    x, states, h = np.array(start, dtype=float), [start], 1 / RATE / steps

    def slope(x, u):
        return np.hstack([x[:, 2:], acceleration(constants, x[:, :2], x[:, 2:], u)])

    for before, after in itertools.pairwise(u):
        for k in range(steps):
            first, middle, last = (before + (after - before) * (k + s) / steps for s in (0, 0.5, 1))
            k1 = slope(x, first)
            k2 = slope(x + h / 2 * k1, middle)
            k3 = slope(x + h / 2 * k2, middle)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3, last))
        states.append(x)
    return np.array(states)


T = np.arange(SECONDS * RATE + 1) / RATE


@pytest.fixture(scope="module")
def motions():
    """Inputs and states of three motions."""
    generator = np.random.default_rng(0)
    size, phase = generator.uniform(-1.2, 1.2, (5, 3)), generator.uniform(0, 6, (5, 3))
    angles = 2 * np.pi * 0.4 * np.arange(1, 6)[:, None] * T[:, None, None] + phase
    u = (size * np.sin(angles)).sum(1)
    start = np.hstack([generator.uniform(-1, 1, (3, 2)), np.zeros((3, 2))])
    x = simulated(TRUTH, start, u)
    return [(u[:, k], x[:, k]) for k in range(3)]


@pytest.fixture(scope="module")
def fitted(motions):
    runs = []
    for seed, (u, x) in enumerate(motions[:2]):
        x = x + 1e-3 * x.std(0) * np.random.default_rng(10 + seed).normal(size=x.shape)
        q, v = torch.from_numpy(x).chunk(2, dim=-1)
        runs.append(Trajectory(q, v, Signal(torch.from_numpy(T), torch.from_numpy(u[:, None]))))
    windows = draw_windows(runs, count=40, steps=4, stride=4, seed=0)
    settings = {"friction": CoulombFriction, "driven_joints": ["elbow"], "start": "generic"}
    model = KnownMechanics(windows.statistics(), RigidChain(URDF), **settings)
    fit = LeastSquares(cutoff=10.0, samples=600).fit(model, runs, windows)
    return model.double(), fit, runs


def test_constants_of_an_acrobot_lie_in_their_intervals(fitted):
    model, fit, _ = fitted
    table = constants_table(model, fit, ["Nm"]).set_index("name")
    names = {
        "m cz of lower": -WEIGHTS[1] / 9.81,
        "viscous friction of shoulder": VISCOUS[0],
        "viscous friction of elbow": VISCOUS[1],
        "Coulomb friction of shoulder": DRY[0],
        "Coulomb friction of elbow": DRY[1],
    }
    assert "armature of elbow" in table.index
    assert not {"armature of shoulder", "torque offset of shoulder"} & {*table.index}  # no motor
    for name, true in names.items():
        row = table.loc[name]
        assert row.known > 0.9, name
        assert row.low <= true <= row.high, name
        assert row.high - row.low < 0.05 + abs(true), name
    assert undetermined(model, fit)


def test_an_acrobot_is_predicted_as_well_as_by_plain_least_squares(motions, fitted):
    model, _, runs = fitted
    u, x = motions[2]
    rows, forces = [], []
    for run in runs:
        filtered = butter(4, 10.0, fs=RATE, output="sos")
        q, v, w = (sosfiltfilt(filtered, y.numpy(), axis=0) for y in (run.q, run.v, run.input.u))
        part = slice(20, -20)
        rows.append(columns(q, v, np.gradient(v, 1 / RATE, axis=0))[part].reshape(-1, 9))
        forces.append(np.c_[0 * w, w][part].reshape(-1))
    plain = np.linalg.lstsq(np.concatenate(rows), np.concatenate(forces), rcond=None)[0]
    span = RATE  # one second, from starts along the motion
    starts = range(0, len(T) - span, RATE // 2)
    truth, w = (
        np.stack([y[k : k + span + 1] for k in starts], axis=1) for y in (x[:, :2], u[:, None])
    )
    t, w = torch.from_numpy(T[: span + 1]), w[..., 0]
    start = np.array([x[k] for k in starts])
    with torch.no_grad():
        signal = Signal(t, torch.from_numpy(w.T[..., None]))
        found = model.predict(torch.from_numpy(start), t, signal).numpy().transpose(1, 0, 2)
    both = found, simulated(plain, start, w)
    errors = [np.linalg.norm(y[..., :2] - truth, axis=-1).mean() for y in both]
    ours, theirs = errors
    assert ours <= theirs
    assert ours < 0.05


def test_laws_use_what_an_acrobot_drives(fitted):
    model, q = copy.deepcopy(fitted[0]), torch.tensor([[0.3, 0.4]]).double()
    law = Regulation(model, 5.0, 1.0)
    motion = [q, 0 * q, 0 * q]
    u = law.law(q, 0 * q, *motion)
    force = model.potential_force(q)[:, 1:] / model.drive_gain()[1]
    torch.testing.assert_close(u, force)
    with pytest.raises(ValueError, match="needs N = M inputs, the robot has M = 1"):
        certify(model, model, q, 5.0, 1.0)


def test_fewer_inputs_than_joints_need_the_names_of_the_driven_joints(fitted):
    statistics = draw_windows(fitted[2], count=9, steps=1, stride=1, seed=0).statistics()
    with pytest.raises(ValueError, match=r"2 coordinates and 1 inputs.*driven_joints"):
        KnownMechanics(statistics, RigidChain(URDF))
    with pytest.raises(ValueError, match="driven_joints"):
        KnownMechanics(statistics, RigidChain(URDF), driven_joints=["wrist"])


def test_slopes_of_passive_joints_are_those_of_the_force(fitted):
    model = copy.deepcopy(fitted[0])
    q, v, a = torch.randn(3, 4, 2, generator=torch.Generator().manual_seed(0)).double()
    at = (q, v, a, v[:, :1])
    torch.testing.assert_close(
        model.slopes().by_parameters(*at), Slopes(model).by_parameters(*at), rtol=1e-6, atol=1e-9
    )
    torch.testing.assert_close(model.slopes().by_state(*at), Slopes(model).by_state(*at))
    torch.testing.assert_close(model.slopes().gain(), Slopes(model).gain())
