"""Friction over time, against an arm of Pinocchio whose friction falls as it warms up."""

from functools import partial

import numpy as np
import pandas as pd
import pytest
import scipy

import pinn_dyn
from pinn_dyn.identification.adaptation import _noise
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares
from tests.evaluation.test_payload import ARM, recording

NAMES = {"q": ["q1", "q2"], "v": ["v1", "v2"], "u": ["tau1", "tau2"]}


def frame(seed, seconds, warming=False):
    """A log of the arm: viscous friction 0.4 and dry friction 0.3, which fall to 60 %."""
    pytest.importorskip("pinocchio", reason="the dev extra is not installed")
    run = recording(seed, seconds=seconds)
    t, v, u = run.t.numpy(), run.v.numpy(), run.u.numpy().copy()
    if warming:
        u -= (1 - factor(t))[:, None] * (0.4 * v + 0.3 * np.tanh(v / 0.02))
    columns = [x for names in NAMES.values() for x in names]
    return pd.DataFrame(np.hstack([run.q, v, u]), columns=columns).assign(t=t)


def factor(t):
    return 0.6 + 0.4 * np.exp(-t / 40)


@pytest.fixture(scope="module")
def run():
    model = partial(KnownMechanics, structure=RigidChain(ARM), friction=CoulombFriction)
    solver = LeastSquares(cutoff=6.0, rollouts=False, samples=1500)
    return pinn_dyn.fit(frame(0, 30.0), **NAMES, model=model, optimizer=solver)


def test_friction_is_followed_while_it_falls(run, tmp_path):
    result = run.adapt(frame(1, 120.0, warming=True))
    for name, rows in result.table.groupby("name"):
        rows = rows[rows.time > 20]
        truth = rows.start * factor(rows.time)
        assert np.abs(rows.value / truth - 1).max() < 0.2, name
        assert ((rows.low < truth) & (truth < rows.high)).mean() > 0.8, name
        assert (rows.high - rows.low).max() < rows.start.max(), name
    total = result.table[result.table.time > 20].pivot(index="time", columns="name", values="value")
    force = 1.5 * total["viscous friction of shoulder"] + total["dry friction of shoulder"]
    expected = (1.5 * 0.4 + 0.3) * factor(force.index)
    assert np.abs(force / expected - 1).max() < 0.1
    result.save(tmp_path / "friction.png")
    assert (tmp_path / "friction.png").stat().st_size > 10_000


def test_friction_that_does_not_change_stays(run):
    table = run.adapt(frame(2, 60.0), constants=["friction", "offset"]).table
    assert set(table.unit) == {"Nms/rad", "Nm"}
    assert table["name"].nunique() == 6
    late = table[table.time > 20]
    inside = (late.low < late.start) & (late.start < late.high)
    assert inside.mean() > 0.8
    offsets = late[late["name"].str.startswith("torque offset")]
    assert np.abs(offsets.value).max() < 0.1


def test_the_noise_of_correlated_errors_gives_the_error_of_their_mean():
    """Against the spread of the means of many AR(1) series with the correlation 0.8."""
    generator = np.random.default_rng(0)
    innovations = generator.normal(size=(300, 1500))
    series = scipy.signal.lfilter([1.0], [1.0, -0.8], innovations, axis=1)[:, 500:]
    rows = np.ones((1000, 1))
    noise = np.mean([_noise(rows, y) for y in series])
    assert noise / 1000**0.5 == pytest.approx(series.mean(axis=1).std(), rel=0.1)


def test_models_without_drives_are_refused(run):
    black_box = pinn_dyn.fit(frame(0, 5.0), **NAMES, model="acceleration", steps=1)
    with pytest.raises(TypeError, match="has no friction to follow"):
        black_box.adapt(frame(0, 5.0))
