"""Logs of simulated robots, clean and with a planted fault, and what their check says."""

import functools
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from pinn_dyn.data.logs import LogSource
from pinn_dyn.log_check.chain import EXCHANGED, SIGN
from pinn_dyn.log_check.check import check
from pinn_dyn.log_check.runs import HELD, RESIDUAL
from pinn_dyn.log_check.structure import FIT, SCALE
from pinn_dyn.systems import RigidChain
from tests.support import delayed_robots, underactuated
from tests.support.random_chains import random_chain
from tests.support.sticking_arms import Arms, mass_and_bias
from tests.support.underactuated import ACROBOT, PENDUBOT

RATE, SECONDS, RUNS = 100.0, 8.0, 6
DELAY, DRIFT, SATURATED = "delay [ms]", "clock drift [%]", "saturated samples"
NEXT = "distance of the input from a measured state"
SLOPE = "dq/dt over v"
TEST_RUN = 3  # of six runs, drawn by the seed 0
OUTSIDE = "test outside"  # true of random motions, and no fault
VISCOUS, DRY = np.array([0.3, 0.3, 0.1]), np.array([0.5, 0.5, 0.15])


def batch(*values):
    return np.array(values, dtype=float)[None]


def arm(base=None, load=0.0):
    """An arm on axes along z, y and x, whose base may be turned, with a load in its last body."""
    moments = [np.diag(x) for x in ([0.02, 0.02, 0.01], [0.004, 0.02, 0.02], [0.006, 0.006, 0.002])]
    return Arms(
        R=batch(np.eye(3) if base is None else base, np.eye(3), np.eye(3)),
        p=batch([0, 0, 0.2], [0, 0.05, 0.3], [0.3, 0, 0]),
        axis=batch([0, 0, 1], [0, 1, 0], [1, 0, 0]),
        mass=batch(2.0, 1.5, 0.8 + load),
        centre=batch([0.02, 0, 0.1], [0.15, 0.02, 0.03], [0.05, 0.06, -0.12]),
        moments=batch(*moments),
        **dict.fromkeys(("armature", "viscous", "dry", "offset"), np.zeros((1, 3))),
    )


def torques(q, v, a, *, base=None, load=0.0, armature=0.02, dry=1.0, spring=(0, 0, 0)):
    """Torques of the arm and its drives, ``(T, 3)``."""
    mass, bias = mass_and_bias(arm(base, load), q[:, None], v[:, None])
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


def exchanged(*names):
    """Exchange the columns of the first two joints."""

    def change(table):
        for name in names:
            table[[f"{name}1", f"{name}2"]] = table[[f"{name}2", f"{name}1"]].to_numpy()

    return change


def from_the_middle(change, *names):
    def edit(table):
        half, columns = len(table) // 2, list(names)
        table.loc[half:, columns] = change(table.loc[half:, columns])

    return edit


def stuck(values):
    return 0 * values + values.iloc[0]


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


def speed_later(table):
    table["u1"] = table["v1"].shift(-2).ffill()


def stopped(seconds):
    """Runs whose joints a brake holds in the middle, while the log shows torques."""
    rows, frames = round(seconds * RATE), {}
    for k, (name, table) in enumerate(arm_runs().items()):
        middle = len(table) // 2 + 20 * k
        held = table.iloc[[middle] * rows].assign(v1=0.0, v2=0.0, v3=0.0)
        held[["u1", "u2", "u3"]] *= 2.0
        parts = pd.concat([table[: middle + 1], held, table[middle + 1 :]], ignore_index=True)
        frames[name] = parts.assign(t=np.arange(len(parts)) / RATE)
    return frames


def loaded_from(share):
    """Runs in which a payload is picked up after a share of the time."""
    frames, loaded = arm_runs(), arm_runs(load=1.6)
    rows = {name: round(share * len(table)) for name, table in frames.items()}
    return {k: pd.concat([x[: rows[k]], loaded[k][rows[k] :]]) for k, x in frames.items()}


def scaled_and_shifted(table):
    table["q2"] = 1.7 * table["q2"] + 0.4
    table["v2"] *= 1.7


def log_of(frames, q_unit="rad", u_unit="Nm"):
    columns = next(iter(frames.values())).columns
    q, v, u = ([x for x in columns if x.startswith(name)] for name in "qvu")
    return LogSource(
        name="planted",
        files=frames,
        time={"columns": "t", "unit": "s"},
        q={"columns": q, "unit": q_unit},
        v={"columns": v, "unit": f"{q_unit}/s"} if v else None,
        u={"columns": u, "unit": u_unit} if u else [],
    )


def bad(measurements):
    """Texts of the measurements that are not ok, by name."""
    texts = {}
    for x in measurements:
        if x.verdict != "ok" and x.name != OUTSIDE:
            texts.setdefault(x.name, []).append(x.text)
    return texts


def findings(frames, structure=None, unit="Nm"):
    """Return the findings of the check, and the check."""
    result = check(log_of(frames, u_unit=unit), structure=structure)
    return bad(result.measurements), result


def read(frames, *units):
    """Return the findings of the check."""
    return bad(check(log_of(frames, *units)).measurements)


WALL = Rotation.from_euler("y", 90, degrees=True).as_matrix()  # gravity along x of the base

PLANTED = {
    # Fault: runs, URDF or not, name of the only bad measurement, words of its texts.
    "all inputs late": (lambda: arm_runs(delay=0.03), False, DELAY, ["'u1'", "'u2'", "'u3'"]),
    "an input late": (lambda: arm_runs(delay=(0, 0.015, 0)), True, DELAY, ["'u2' acts"]),
    "torque reversed": (lambda: edited(times(-1, "u2")), False, SIGN, ["'u2' seems"]),
    "torques exchanged": (
        lambda: edited(exchanged("u")),
        True,
        EXCHANGED,
        ["the inputs 'u1' and 'u2' are"],
    ),
    "clock 2 %": (lambda: edited(clock(0.02)), False, DRIFT, ["'u1' drifts by", "too early"]),
    "drive saturates": (lambda: edited(commanded), False, SATURATED, ["'u2' is a command"]),
    "v late": (lambda: edited(late_velocity), False, "lag of v [ms]", ["30 ms behind"]),
    "next state": (lambda: edited(next_state), False, NEXT, ["'u1'", "'u2'", "'u3'"]),
    "joint reversed": (lambda: edited(times(-1, "q3", "v3", "u3")), True, FIT, ["joint2 turns"]),
    "wall": (lambda: arm_runs(base=WALL), True, FIT, ["gravity=[9.81, 0.0, 0.0]"]),
    "gear": (
        lambda: edited(times(0.02, "u2")),
        True,
        SCALE,
        ["'u2' is 0.02 t", "at the motor"],
    ),
    "spring": (lambda: arm_runs(spring=(8, 0, 0)), True, FIT, ["springs=['joint0']"]),
    "brake": (lambda: stopped(0.5), False, HELD, ["and 5 more parts: the joints are held"]),
    "long brake": (lambda: stopped(1.0), True, HELD, ["and 5 more parts: the joints are held"]),
    "payload in half": (lambda: loaded_from(0.5), False, RESIDUAL, ["another payload"]),
    "payload in a third": (lambda: loaded_from(0.67), True, RESIDUAL, ["another payload"]),
    "later speed": (lambda: edited(speed_later), False, NEXT, ["speed of 'q1', 2 rows later"]),
    "factor and offset": (
        lambda: edited(scaled_and_shifted),
        True,
        FIT,
        ["1.7 times", "joint1 is 0."],
    ),
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
    reasons = [x.reason for x in result.delays]
    assert ("the drive saturates" in reasons) == (name == SATURATED)


FORCES, MOTION = ("u1", "u2", "u3"), ("q1", "q2", "q3", "v1", "v2", "v3")
UNKNOWN = "is it another payload"
BAD_RUNS = {
    # Fault of a run: change, and words about it by measurement.
    "half a turn": (shifted(np.pi), {RESIDUAL: UNKNOWN}),
    "mNm": (times(1e3, *FORCES), {RESIDUAL: "another unit"}),
    "ten": (times(10, *FORCES), {RESIDUAL: "another unit"}),
    "reversed": (times(-1, *FORCES), {RESIDUAL: "sign reversed"}),
    "torques exchanged": (exchanged("u"), {RESIDUAL: "are they exchanged"}),
    "joints exchanged": (exchanged(*"qvu"), {RESIDUAL: UNKNOWN}),
    "stuck torque": (from_the_middle(stuck, "u2"), {RESIDUAL: "sensor stuck"}),
    "degrees": (times(180 / np.pi, "v2"), {SLOPE: "0.0174"}),
    "stuck angle": (from_the_middle(stuck, "q2"), {RESIDUAL: UNKNOWN, SLOPE: "'q2'"}),
    "stuck speed": (from_the_middle(stuck, "v2"), {SLOPE: "columns 'q2' and 'v2'"}),
    "motion reversed": (
        from_the_middle(np.negative, *MOTION),
        {RESIDUAL: UNKNOWN, "jumps and spikes": "row 400, column 'q"},
    ),
}


@pytest.mark.parametrize("fault", BAD_RUNS)
def test_a_bad_run_gets_its_word_and_no_other(fault):
    """A training run and the test run in turn."""
    change, words = BAD_RUNS[fault]
    k = (2, TEST_RUN)[list(BAD_RUNS).index(fault) % 2]
    texts = read(edited(change, [k]))
    assert texts.keys() == words.keys(), texts
    for name, word in words.items():
        assert all(f"run{k}" in text and word in text for text in texts[name]), texts


def test_a_good_run_of_poses_that_no_other_run_has_is_not_bad():
    t, (q, v), acting = motions(0, 0.0)[2]
    q = q + np.array([0.0, 1.5, 1.0])
    elsewhere = frame(t, q, torques(q, v, acting[0][2]), v)
    assert read({**arm_runs(), "run2": elsewhere}) == {}


def test_another_payload_is_named():
    frames = {**arm_runs(), "run2": arm_runs(load=1.6)["run2"]}
    assert "run run2 does not fit" in read(frames)[RESIDUAL][0]


@pytest.mark.parametrize(("reversed_runs", "named"), [([1, 4], ["run1", "run4"]), ([0, 1, 4], [])])
def test_at_most_a_third_of_the_runs_is_bad(reversed_runs, named):
    texts = read(edited(times(-1, *FORCES), reversed_runs)).get(RESIDUAL, [])
    assert [text.split()[1] for text in texts] == named


def test_v_reversed_after_the_first_half_of_each_run():
    (text,) = read(edited(from_the_middle(np.negative, "v2")))[SLOPE]
    assert "(4 to 8 s) and 5 more runs, columns 'q2' and 'v2': the derivative of q is -1" in text


def test_a_short_run_is_not_compared():
    frames = edited(times(10, "u1"), [0])
    short = {"run0": frames["run0"][:100], "run1": frames["run1"], "run3": frames["run3"]}
    assert RESIDUAL not in read(short)


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


def test_a_slow_run_with_dry_friction_is_good():
    """A slide of 1.2 kg with 4 N of dry friction; one run has a tenth of the amplitude."""

    def run(seed, size):
        rng, t = np.random.default_rng(seed), np.arange(2000) / 250
        sines = delayed_robots.sines(np.random.default_rng(seed), 1, size=size, highest=1.0)
        q, v, a = (sines(t, order) for order in range(3))
        u = 1.2 * (a + 9.81) + 4 * np.tanh(1e3 * v)
        return frame(t, q, u + 0.05 * rng.normal(size=u.shape), v)

    assert read({f"r{k}": run(k, 0.004 if k == 2 else 0.04) for k in range(RUNS)}, "m", "N") == {}


def test_a_bad_run_of_a_robot_with_more_inputs_than_coordinates():
    def run(seed):
        t = np.arange(801) / 100
        u, q = delayed_robots.sines(np.random.default_rng(seed), 3, size=1.0)(t), [np.zeros(2)]
        for x in u[:-1]:
            q.append(q[-1] + 0.01 * delayed_robots.tendons(q[-1], x))
        return frame(t, np.array(q), u, np.gradient(np.array(q), 0.01, axis=0))

    runs = {f"r{k}": run(k) for k in range(RUNS)}
    assert read(runs, "rad", "rad") == {}
    times(-1, *FORCES)(runs["r4"])
    texts = read(runs, "rad", "rad")
    assert texts.keys() == {RESIDUAL}
    assert "run r4 does not fit" in texts[RESIDUAL][0]
    assert "sign reversed" in texts[RESIDUAL][0]


def pushed_backwards(runs, columns):
    """Inputs that are said to push backwards if the columns are reversed."""
    reverse = {name: x.assign(**{c: -x[c] for c in columns}) for name, x in runs.items()}
    return [x.split("'")[1] for x in read(reverse)[SIGN]]


def closed_loop(seed, gravity=False):
    """Motions of a chain of three bodies under PD control, ``(runs, T, 3)`` each."""
    generator = np.random.default_rng(seed)
    chain = RigidChain(random_chain(generator))
    while chain.num_coordinates != 3:
        chain = RigidChain(random_chain(generator))
    reference = delayed_robots.sines(generator, 15, size=0.6, highest=1.0)
    step, rows = 0.005, []
    q = torch.from_numpy(reference(0.0)).reshape(5, 3)
    v = torch.from_numpy(reference(0.0, 1)).reshape(5, 3)
    for k in range(2 * 801):
        target, speed = (torch.from_numpy(reference(k * step, i)).reshape(5, 3) for i in (0, 1))
        mass, bias = chain.mass_and_bias(q, v)
        if k % 2 == 0:  # 100 Hz
            gains = mass.diagonal(dim1=1, dim2=2)
            u = gains * (100 * (target - q) + 15 * (speed - v))
            u = u + chain.rigid_force(q, 0 * v, 0 * v) if gravity else u
            rows.append(torch.stack([q, v, u]))
        friction = gains * (0.5 * v + 0.5 * torch.tanh(10 * v))
        v = v + step * torch.linalg.solve(mass, (u - bias - friction).unsqueeze(-1)).squeeze(-1)
        q = q + step * v
    motions = torch.stack(rows, dim=2).numpy()
    t = np.arange(801) / 100
    return {f"r{k}": frame(t, q, u, v) for k, (q, v, u) in enumerate(motions.swapaxes(0, 1))}


@pytest.mark.parametrize("gravity", [False, True])
def test_signs_of_an_arm_under_a_controller(gravity):
    runs = closed_loop(3 if gravity else 2, gravity)
    assert read(runs) == {}
    for names in (["u1", "u2", "u3"], ["u2"]):
        assert pushed_backwards(runs, names) == names


@pytest.mark.parametrize("robot", [PENDUBOT, ACROBOT], ids=["pendubot", "acrobot"])
def test_sign_of_an_underactuated_robot(robot):
    frames = underactuated.log(robot, 5).rename(columns={"u": "u1"}).groupby("run")
    runs = {f"r{k}": frame.drop(columns="run") for k, (_, frame) in enumerate(frames)}
    assert read(runs) == {}
    assert pushed_backwards(runs, ["u1"]) == ["u1"]
