"""Logs of simulated robots, clean and with a planted fault, and the words of their check."""

import functools
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from pinn_dyn.data.logs import RESIDUAL, LogSource
from pinn_dyn.data.logs.runs import INERTIA
from pinn_dyn.evaluation.log_check import check
from pinn_dyn.evaluation.structure_check import SCALE
from pinn_dyn.systems import RigidChain
from tests.support import delayed_robots
from tests.support.sticking_arms import Arms, mass_and_bias

RATE, SECONDS, RUNS = 100.0, 8.0, 6
FIT = "share that the URDF does not explain"
DELAY, DRIFT, SATURATED = "delay [ms]", "clock drift [%]", "saturated samples"
NEXT = "distance of the input from the next q"
OUTSIDE = "test outside"  # true of random motions, and no fault
VISCOUS, DRY = np.array([0.3, 0.3, 0.1]), np.array([0.5, 0.5, 0.15])


def batch(*values):
    return np.array(values, dtype=float)[None]


def arm(base=None):
    """An arm on axes along z, y and x, whose base may be turned."""
    moments = [np.diag(x) for x in ([0.02, 0.02, 0.01], [0.004, 0.02, 0.02], [0.006, 0.006, 0.002])]
    return Arms(
        R=batch(np.eye(3) if base is None else base, np.eye(3), np.eye(3)),
        p=batch([0, 0, 0.2], [0, 0.05, 0.3], [0.3, 0, 0]),
        axis=batch([0, 0, 1], [0, 1, 0], [1, 0, 0]),
        mass=batch(2.0, 1.5, 0.8),
        centre=batch([0.02, 0, 0.1], [0.15, 0.02, 0.03], [0.05, 0.06, -0.12]),
        moments=batch(*moments),
        **dict.fromkeys(("armature", "viscous", "dry", "offset"), np.zeros((1, 3))),
    )


def torques(q, v, a, *, base=None, armature=0.02, dry=1.0, spring=(0, 0, 0)):
    """Torques of the arm and its drives, ``(T, 3)``."""
    mass, bias = mass_and_bias(arm(base), q[:, None], v[:, None])
    rigid = np.einsum("tij,tj->ti", mass[:, 0], a) + bias[:, 0]
    return rigid + armature * a + VISCOUS * v + dry * DRY * np.tanh(v / 0.02) + q * spring


def frame(t, q, u, v=None):
    signals = {"q": q, "u": u} | ({} if v is None else {"v": v})
    columns = {f"{name}{k + 1}": c for name, x in signals.items() for k, c in enumerate(x.T)}
    return pd.DataFrame({"t": t, **columns})


@functools.cache
def motions(seed, delay):
    """Runs of the arm: times, and q, v, a ``(T, 3)`` at the time when an input acts."""
    t = np.arange(round(SECONDS * RATE) + 1) / RATE
    lags = np.resize(np.array(delay, dtype=float), 3)
    runs = []
    for k in range(RUNS):
        sines = delayed_robots.sines(
            np.random.default_rng(100 * seed + k), 3, size=0.6, highest=1.5
        )
        acting = [np.array([sines(t + d, order) for order in range(3)]) for d in lags]
        runs.append((t, [sines(t, 0), sines(t, 1)], acting))
    return runs


def arm_runs(seed=0, delay=0.0, **changes):
    """Logs of the arm with an encoder of 2e-5 rad and 1 % noise of the torques."""
    frames = {}
    for k, (t, (q, v), acting) in enumerate(motions(seed, delay)):
        rng = np.random.default_rng(k)
        u = np.stack([torques(*x, **changes)[:, i] for i, x in enumerate(acting)], axis=1)
        u = u + 0.01 * u.std(axis=0) * rng.normal(size=u.shape)
        q = 2e-5 * np.round(q / 2e-5)
        frames[f"run{k}"] = frame(t, q, u, v + 1e-3 * rng.normal(size=v.shape))
    return frames


def edited(change, runs=range(RUNS), **arguments):
    frames = arm_runs(**arguments)
    for k, table in enumerate(frames.values()):
        if k in runs:
            change(table)
    return frames


def times(factor, *names):
    def change(table):
        table[list(names)] *= factor

    return change


def exchanged(table):
    table[["u1", "u2"]] = table[["u2", "u1"]].to_numpy()


def clock(rate):
    def change(table):
        for name in ("u1", "u2", "u3"):
            table[name] = np.interp(table.t * (1 + rate), table.t, table[name])

    return change


def commanded(table):
    limit = np.quantile(np.abs(table.u2), 0.8)
    table.u2 += 3 * np.sign(table.u2) * (np.abs(table.u2) - limit).clip(lower=0)


def late_velocity(table):
    names = ["v1", "v2", "v3"]
    table[names] = table[names].shift(3).bfill()


def next_state(table):
    table[["u1", "u2", "u3"]] = table[["q1", "q2", "q3"]].shift(-1).ffill()


def shifted(offset):
    def change(table):
        table.q2 += offset

    return change


def noisy(table):
    """Torques with slow noise that no equation explains."""
    rng, mean = np.random.default_rng(0), np.ones(21) / 21**0.5
    for name in ("u1", "u2", "u3"):
        noise = np.convolve(rng.normal(size=len(table) + 20), mean, "valid")
        table[name] += 0.3 * table[name].std() * noise


def findings(frames, structure=None, unit="Nm"):
    """Texts of the check that are not ok, by the name of their measurement, and the check."""
    columns = next(iter(frames.values())).columns
    q, v, u = ([x for x in columns if x.startswith(name)] for name in "qvu")
    source = LogSource(
        name="planted",
        files=frames,
        time={"columns": "t", "unit": "s"},
        q={"columns": q, "unit": "rad"},
        v={"columns": v, "unit": "rad/s"} if v else None,
        u={"columns": u, "unit": unit} if u else [],
    )
    result = check(source, structure=structure)
    texts = {}
    for x in result.measurements:
        if x.verdict != "ok" and x.name != OUTSIDE:
            texts.setdefault(x.name, []).append(x.text)
    return texts, result


WALL = Rotation.from_euler("y", 90, degrees=True).as_matrix()  # gravity along x of the base

PLANTED = {
    # Fault: runs, URDF or not, name of the only bad measurement, words of its texts.
    "all inputs late": (lambda: arm_runs(delay=0.03), False, DELAY, ["'u1'", "'u2'", "'u3'"]),
    "an input late": (lambda: arm_runs(delay=(0, 0.015, 0)), True, DELAY, ["'u2' acts"]),
    "torque reversed": (lambda: edited(times(-1, "u2")), False, INERTIA, ["'u2' seems"]),
    "torques exchanged": (lambda: edited(exchanged), True, FIT, ["inputs of the joints joint0"]),
    "clock 2 %": (lambda: edited(clock(0.02)), False, DRIFT, ["'u1' drifts by 2 %", "too early"]),
    "drive saturates": (lambda: edited(commanded), False, SATURATED, ["'u2' is a command"]),
    "half a turn": (lambda: edited(shifted(np.pi), [1]), False, RESIDUAL, ["run1"]),
    "mNm": (lambda: edited(times(1e3, "u2"), [2]), False, RESIDUAL, ["run2", "another unit"]),
    "v late": (lambda: edited(late_velocity), False, "lag of v [ms]", ["30 ms behind"]),
    "next state": (lambda: edited(next_state), False, NEXT, ["'u1'", "'u2'", "'u3'"]),
    "joint reversed": (lambda: edited(times(-1, "q3", "v3", "u3")), True, FIT, ["joint2 turns"]),
    "wall": (lambda: arm_runs(base=WALL), True, FIT, ["gravity=[9.81, 0.0, 0.0]"]),
    "gear": (lambda: edited(times(0.02, "u2")), True, SCALE, ["'u2' is 0.019", "at the motor"]),
    "spring": (lambda: arm_runs(spring=(8, 0, 0)), True, FIT, ["model.springs=[joint0]"]),
    "homing": (lambda: edited(shifted(1.0)), True, FIT, ["joint1 is", "off: add -"]),
}

# The causes of a URDF that does not fit are tried one after the other.
MARKED = [
    pytest.param(name, marks=pytest.mark.slow if row[2] == FIT else ())
    for name, row in PLANTED.items()
]


@pytest.mark.parametrize("fault", MARKED)
def test_a_planted_fault_gets_its_word_and_no_other(fault):
    frames, structure, name, words = PLANTED[fault]
    texts, result = findings(frames(), RigidChain(arm().urdf(0)) if structure else None)
    assert set(texts) == {name}, texts
    for word in words:
        assert any(word in x for x in texts[name]), texts
    assert result.delay is None or name == DELAY


def masses_wrong():
    """The URDF of the arm with masses that are up to 40 % wrong."""
    factor = np.array([1.4, 0.6, 1.4])
    right = arm()
    wrong = replace(right, mass=right.mass * factor, moments=right.moments * factor[:, None, None])
    return RigidChain(wrong.urdf(0))


def pendulum(seed):
    """A double pendulum of points of 1 kg on rods of 0.3 m that nothing drives."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(SECONDS * RATE)) / RATE

    def rate(_, x):
        q, v = x[:2], x[2:]
        c, s = np.cos(q[0] - q[1]), np.sin(q[0] - q[1])
        mass = 0.09 * np.array([[2, c], [c, 1]])
        force = 0.09 * s * np.array([v[1] ** 2, -(v[0] ** 2)]) + 0.003 * v
        return np.concatenate([v, -np.linalg.solve(mass, force + 2.943 * np.sin(q) * [2, 1])])

    start = np.concatenate([rng.uniform(-1.3, 1.3, 2), np.zeros(2)])
    q = solve_ivp(rate, (0, t[-1]), start, t_eval=t, rtol=1e-7, atol=1e-8).y[:2].T
    return frame(t, q + 1e-4 * rng.normal(size=q.shape), np.empty((len(t), 0)))


def recorded(log):
    return {f"run{k}": frame(x.t, x.q, x.u) for k, x in enumerate(map(log, range(RUNS)))}


def coarse(seed):
    """Joints that stick and rest, with an encoder of 1e-3 rad."""
    log = delayed_robots.resting(0.4, seconds=SECONDS, seed=seed)
    return replace(log, q=1e-3 * np.round(log.q / 1e-3))


def tendons(seed):
    return delayed_robots.log("tendons", seed, 0.0, seconds=SECONDS)


CLEAN = {
    # Kind of log: runs, URDF or None, unit of the inputs.
    "arm": (arm_runs, None, "Nm"),
    "slow log": (lambda: edited(lambda x: x.drop(x.index[1::2], inplace=True)), None, "Nm"),
    "currents": (lambda: edited(times(0.2, "u1", "u3")), None, "A"),
    "masses wrong": (arm_runs, masses_wrong, "Nm"),
    "geared": (lambda: arm_runs(armature=0.3, dry=4.0), lambda: RigidChain(arm().urdf(0)), "Nm"),
    "noisy torques": (lambda: edited(noisy), lambda: RigidChain(arm().urdf(0)), "Nm"),
    "sticks and rests": (lambda: recorded(coarse), None, "Nm"),
    "tendons": (lambda: recorded(tendons), None, "rad"),
    "pendulum": (lambda: {f"run{k}": pendulum(k) for k in range(RUNS)}, None, "1"),
}


@pytest.mark.parametrize("kind", CLEAN)
def test_a_clean_log_gets_no_word(kind):
    frames, structure, unit = CLEAN[kind]
    texts, result = findings(frames(), structure and structure(), unit)
    assert texts == {}
    assert result.delay is None
