"""Comparison of runs: a bad run among good runs, a bad stretch of v, signs of the inputs."""

import numpy as np
import pandas as pd
import pytest
import torch

from pinn_dyn.data.logs import LogSource
from pinn_dyn.systems import RigidChain
from tests.support import underactuated
from tests.support.delayed_robots import arm_torque, sines, tendons
from tests.support.random_chains import random_chain
from tests.support.underactuated import ACROBOT, PENDUBOT

T = np.arange(801) / 100


def frame(q, v, u, t=T):
    signals = {"q": q, "v": v, "u": u}
    columns = {f"{s}{k + 1}": x[:, k] for s, x in signals.items() for k in range(x.shape[1])}
    return pd.DataFrame({"t": t, **columns})


def arm(seed, torque=arm_torque):
    rng = np.random.default_rng(seed)
    motion = sines(rng, 2, size=0.5, highest=1.0)
    q, v, a = (motion(T, order) for order in range(3))
    u = torque(q, v, a)
    return frame(*(x + 1e-3 * x.std(0) * rng.normal(size=x.shape) for x in (q, v, u)))


def heavy(q, v, a):
    """The arm with a load of 0.6 kg at the tip."""
    l1, l2, m = 0.5, 0.4, 0.6
    c, s = np.cos(q[:, 1]), np.sin(q[:, 1])
    tip = m * l2**2 * a.sum(1) + m * l1 * l2 * (c * a[:, 0] + s * v[:, 0] ** 2)
    tip += m * 9.81 * l2 * np.sin(q.sum(1))
    base = m * l1**2 * a[:, 0] + m * 9.81 * l1 * np.sin(q[:, 0])
    base += m * l1 * l2 * (c * a.sum(1) - s * v.sum(1) ** 2)
    return arm_torque(q, v, a) + np.stack([base + tip, tip], axis=1)


def measured(runs, unit="rad", force="Nm"):
    """Warnings of a log with the validation run r1 and the test run r3, jumps left aside."""
    first = next(iter(runs.values()))
    q, v, u = ([x for x in first if x.startswith(letter)] for letter in "qvu")
    log = LogSource(
        name="arm",
        files=runs,
        time=dict(columns="t", unit="s"),
        q=dict(columns=q, unit=unit),
        v=dict(columns=v, unit=[f"{x}/s" for x in unit] if isinstance(unit, list) else f"{unit}/s"),
        u=dict(columns=u, unit=force),
        validation=dict(runs=["r1"], piece=1.0),
        test=dict(runs=["r3"], piece=1.0),
    )
    log.load()
    bad = [x for x in log.measurements if x.verdict != "ok" and x.name != "jumps and spikes"]
    return [x.text for x in bad]


@pytest.fixture(scope="module")
def arms():
    return {f"r{k}": arm(k) for k in range(6)}


def test_a_slow_run_with_dry_friction_is_good():
    """A slide of 1.2 kg with 4 N of dry friction; one run has a tenth of the amplitude."""

    def run(seed, size):
        rng, t = np.random.default_rng(seed), np.arange(2000) / 250
        q, v, a = (
            sines(np.random.default_rng(seed), 1, size=size, highest=1.0)(t, k) for k in range(3)
        )
        u = 1.2 * (a + 9.81) + 4 * np.tanh(1e3 * v)
        return frame(q, v, u + 0.05 * rng.normal(size=u.shape), t)

    runs = {f"r{k}": run(k, 0.004 if k == 2 else 0.04) for k in range(6)}
    assert measured(runs, unit="m", force="N") == []


def exchanged(table):
    names = {f"{s}{k}": f"{s}{3 - k}" for s in "qvu" for k in (1, 2)}
    return table.rename(columns=names)[list(table)]


def from_the_middle(table, columns, change):
    table = table.copy()
    table.loc[len(table) // 2 :, columns] = change(table.loc[len(table) // 2 :, columns])
    return table


FORCES = ["u1", "u2"]
MOTION = ["q1", "q2", "v1", "v2"]
BAD_RUNS = {
    "reversed": (lambda x: x.assign(u1=-x.u1, u2=-x.u2), "sign reversed"),
    "mNm": (lambda x: x.assign(u1=1e3 * x.u1, u2=1e3 * x.u2), "another unit"),
    "ten": (lambda x: x.assign(u1=10 * x.u1, u2=10 * x.u2), "another unit"),
    "torques exchanged": (lambda x: x.assign(u1=x.u2, u2=x.u1), "are they exchanged"),
    "joints exchanged": (exchanged, "does not fit"),
    "motion reversed": (lambda x: from_the_middle(x, MOTION, np.negative), "does not fit"),
    "stuck torque": (lambda x: from_the_middle(x, "u1", lambda y: 0 * y + y.iloc[0]), "stuck"),
    "stuck angle": (
        lambda x: from_the_middle(x, "q1", lambda y: 0 * y + y.iloc[0]),
        "does not fit",
    ),
    "stuck speed": (lambda x: from_the_middle(x, "v2", lambda y: 0 * y + y.iloc[0]), "stuck"),
    "degrees": (lambda x: x.assign(v1=np.degrees(x.v1)), "another unit"),
}


@pytest.mark.parametrize("name", BAD_RUNS)
def test_a_bad_run_is_named_with_its_cause(arms, name):
    """A training run and the test run in turn."""
    change, cause = BAD_RUNS[name]
    run = ("r2", "r3")[list(BAD_RUNS).index(name) % 2]
    texts = measured({**arms, run: change(arms[run])})
    assert any(run in text and cause in text for text in texts)
    assert all(run in text for text in texts)


def test_another_payload_is_named(arms):
    (text,) = measured({**arms, "r2": arm(2, heavy)})
    assert "run r2 does not fit" in text


def test_good_runs_and_two_runs_have_no_warning(arms):
    assert measured(arms) == []
    two = {"r1": arms["r1"], "r3": arms["r3"], "r0": arms["r0"].assign(u1=10 * arms["r0"].u1)[:100]}
    assert not any("does not fit" in text for text in measured(two))


def test_a_bad_run_of_a_robot_with_more_inputs_than_coordinates():
    def run(seed):
        signal = sines(np.random.default_rng(seed), 3, size=1.0)
        u, q = signal(T), [np.zeros(2)]
        for x in u[:-1]:
            q.append(q[-1] + 0.01 * tendons(q[-1], x))
        q = np.array(q)
        return frame(q, np.gradient(q, 0.01, axis=0), u)

    runs = {f"r{k}": run(k) for k in range(6)}
    assert measured(runs, force="rad") == []
    bad = runs["r4"].assign(**{f"u{k}": -runs["r4"][f"u{k}"] for k in (1, 2, 3)})
    (text,) = measured({**runs, "r4": bad}, force="rad")
    assert "run r4 does not fit" in text
    assert "sign reversed" in text


def test_v_reversed_after_the_first_half_of_each_run(arms):
    runs = {name: from_the_middle(x, ["v2"], np.negative) for name, x in arms.items()}
    texts = measured(runs)
    (text,) = [x for x in texts if "derivative" in x]
    assert "(4 to 8 s) and 5 more runs, columns 'q2' and 'v2': the derivative of q is -1" in text


def pushed_backwards(runs, columns, **units):
    reverse = {name: x.assign(**{c: -x[c] for c in columns}) for name, x in runs.items()}
    return [x.split("'")[1] for x in measured(reverse, **units) if "backwards" in x]


def closed_loop(seed, gravity=False):
    """Motions of a chain of three bodies under PD control, ``(runs, T, 3)`` each."""
    generator = np.random.default_rng(seed)
    chain = RigidChain(random_chain(generator))
    while chain.num_coordinates != 3:
        chain = RigidChain(random_chain(generator))
    reference = sines(generator, 15, size=0.6, highest=1.0)
    step, rows = 0.005, []
    q = torch.from_numpy(reference(0.0)).reshape(5, 3)
    v = torch.from_numpy(reference(0.0, 1)).reshape(5, 3)
    for k in range(2 * len(T)):
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
    return {f"r{k}": frame(*motions[:, k]) for k in range(5)}


@pytest.mark.parametrize("gravity", [False, True])
def test_signs_of_an_arm_under_a_controller(gravity):
    runs = closed_loop(3 if gravity else 2, gravity)
    assert measured(runs) == []
    for names in (["u1", "u2", "u3"], ["u2"]):
        assert pushed_backwards(runs, names) == names


@pytest.mark.parametrize("robot", [PENDUBOT, ACROBOT], ids=["pendubot", "acrobot"])
def test_sign_of_an_underactuated_robot(robot):
    frames = underactuated.log(robot, 5).rename(columns={"u": "u1"}).groupby("run")
    runs = {f"r{k}": frame.drop(columns="run") for k, (_, frame) in enumerate(frames)}
    assert measured(runs) == []
    assert pushed_backwards(runs, ["u1"]) == ["u1"]
