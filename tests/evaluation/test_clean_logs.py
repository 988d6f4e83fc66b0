"""Clean logs of random arms, of which the check has nothing to say."""

import numpy as np
import pandas as pd
import pytest
import torch

from pinn_dyn.data.logs import LogSource
from pinn_dyn.log_check.check import check
from pinn_dyn.systems import RigidChain
from tests.support.random_chains import random_chain

RATES = (50, 100, 200, 250, 500, 1000)  # Hz
RUNS, SECONDS = 5, 8.0
# True of some random motions, and no faults of a log.
EXCITATION = ("test outside", "condition number")


def motion(rng, t, size, highest):
    """q = A sin(sum of sines), which stays in its range, and its derivatives, ``(T, N)``."""
    q, speed, bend = np.zeros((3, len(t), len(size)))
    for _ in range(4):
        w = 2 * np.pi * rng.uniform(0.1, highest, len(size))
        angle = t[:, None] * w + rng.uniform(0, 2 * np.pi, len(size))
        amplitude = rng.uniform(0.6, 1.2, len(size))
        q += amplitude * np.sin(angle)
        speed += amplitude * w * np.cos(angle)
        bend -= amplitude * w**2 * np.sin(angle)
    sine, cosine = np.sin(q), np.cos(q)
    return size * sine, size * cosine * speed, size * (cosine * bend - sine * speed**2)


def clean_log(seed):
    """A log of a random arm with friction, and its URDF or None.

    Rates, noise, an encoder, measured speeds and hard motion vary with the seed.
    """
    rng = np.random.default_rng(seed)
    chain = RigidChain(random_chain(rng))
    count, rate = chain.num_coordinates, RATES[seed % 6]
    hard = seed % 4 == 3
    size = rng.uniform(0.6, 1.5, count) * (1.6 if hard else 1.0)
    viscous, dry, armature = rng.uniform(0, 1, (3, count)) * np.array([[0.1], [0.15], [0.2]])
    t = np.arange(round(SECONDS * rate)) / rate
    frames, scales = {}, None
    for k in range(RUNS):
        q, v, a = motion(rng, t, size, 0.6 if hard else 0.3)
        force = chain.rigid_force(*map(torch.from_numpy, (q, v, a))).numpy()
        scales = [x.std(axis=0) for x in (force, v, a)] if scales is None else scales
        of_u, of_v, of_a = scales
        drive = viscous * v / of_v + dry * np.tanh(100 * v / of_v) + armature * a / of_a
        measured = q + 10 ** rng.uniform(-6, -4.3) * rng.normal(size=q.shape)
        if seed % 5 == 1:
            tick = 2 * np.pi / 2**14
            measured = tick * np.round(measured / tick)
        u = force + of_u * drive + 10 ** rng.uniform(-4, -1.7) * of_u * rng.normal(size=q.shape)
        signals = {"q": measured, "u": u}
        if seed % 3:
            signals["v"] = v + 10 ** rng.uniform(-4, -2) * of_v * rng.normal(size=q.shape)
        columns = {f"{name}{j}": x[:, j] for name, x in signals.items() for j in range(count)}
        frames[f"run{k}"] = pd.DataFrame({"t": t, **columns})
    names = {name: [f"{name}{j}" for j in range(count)] for name in "qvu"}
    source = LogSource(
        name="clean",
        files=frames,
        time="t",
        q={"columns": names["q"], "unit": "rad"},
        v={"columns": names["v"], "unit": "rad/s"} if seed % 3 else None,
        u={"columns": names["u"], "unit": "Nm"},
    )
    return source, chain if seed % 2 == 0 else None


SEEDS = [pytest.param(k, marks=pytest.mark.slow if k > 5 else ()) for k in range(20)]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_clean_log_gets_no_warning(seed):
    source, structure = clean_log(seed)
    result = check(source, structure=structure)
    findings = [x for x in result.measurements if x.verdict != "ok"]
    assert [x.text for x in findings if not x.name.startswith(EXCITATION)] == []
    assert result.delay is None
