"""Loads on an arm whose torques Pinocchio computes, with noise and friction."""

import numpy as np
import pytest
import torch

from pinn_dyn.identification.payload import identify_payload
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares
from tests.support.arm_urdf import changed
from tests.support.known import statistics

pinocchio = pytest.importorskip("pinocchio", reason="the dev extra is not installed")
LIMIT = '<limit lower="-9" upper="9" velocity="9" effort="99"/>'
ARM = changed(("continuous", "revolute"), ('<axis xyz="1 0 0"/>', f'<axis xyz="1 0 0"/>{LIMIT}'))
MASS, CENTER = 0.9, np.array([0.05, -0.03, -0.1])
INERTIA = np.array([[0.02, 0.003, 0.001], [0.003, 0.015, 0.002], [0.001, 0.002, 0.012]])
TRUTH = np.array([MASS, *CENTER, 0.02, 0.003, 0.015, 0.001, 0.002, 0.012])


def recording(seed, load=None, urdf=ARM, seconds=20.0, rate=100.0):
    """A motion of sines, with noise of 0.3 mrad, 3 mrad/s and 0.02 Nm."""
    model = pinocchio.buildModelFromXML(urdf)
    if load is not None:
        mass, center, inertia = load
        model.inertias[model.njoints - 1] += pinocchio.Inertia(mass, center, inertia)
    generator, size = np.random.default_rng(seed), model.nq
    t = np.arange(int(seconds * rate)) / rate
    q, v, a = np.zeros((3, len(t), size))
    for k in range(1, 9):
        phase, height = generator.uniform(0, 6, size), generator.normal(size=size) * 0.6 / k**0.5
        w = 2 * np.pi * 0.15 * k**1.1  # not periodic
        angle = w * t[:, None] + phase
        q += height * np.sin(angle)
        v += height * w * np.cos(angle)
        a -= height * w**2 * np.sin(angle)
    data = model.createData()
    tau = np.array([pinocchio.rnea(model, data, *row) for row in zip(q, v, a, strict=True)])
    tau += 0.05 * a + 0.4 * v + 0.3 * np.tanh(v / 0.02)
    noise = [s * generator.normal(size=q.shape) for s in (3e-4, 3e-3, 0.02)]
    q, v, tau = (torch.from_numpy(x + e) for x, e in zip((q, v, tau), noise, strict=True))
    return Trajectory(q, v, Signal(torch.from_numpy(t), tau))


def identified(seed, load, urdf=ARM, samples=1000):
    structure = RigidChain(urdf)
    scales = statistics(structure.num_coordinates)
    model = KnownMechanics(scales, structure, start="generic", friction=CoulombFriction)
    without, loaded = recording(seed, None, urdf), recording(seed + 1000, load, urdf)
    return identify_payload(model, [without], [loaded], cutoff=6.0, samples=samples)


def test_mass_center_and_inertia_of_a_load_are_identified():
    table = identified(0, (MASS, CENTER, INERTIA))
    assert table.value[0] == pytest.approx(MASS, rel=0.02)
    np.testing.assert_allclose(table.value[1:4], CENTER, atol=5e-3)
    np.testing.assert_allclose(table.value[4:], TRUTH[4:], atol=4e-3)
    assert (table.high[:4] - table.low[:4] < [0.1, 0.02, 0.02, 0.02]).all()
    assert (table.determined == "yes").all()


def test_no_load_has_an_interval_with_zero():
    load = identified(2, None)
    row = load.iloc[0]
    assert row.low < 0 < row.high < 0.1
    assert (load.determined[1:] == "not determined").all()


def test_a_number_that_the_motions_do_not_determine_is_named():
    """In a plane no motion depends on the center along the axes, and on moments about others."""
    load = identified(3, (MASS, 4 * CENTER, INERTIA), ARM.replace('"1 0 0"', '"0 1 0"'))
    table = load.set_index("name")
    hidden = ["center y", "Ixx", "Ixy", "Ixz", "Iyz", "Izz"]
    assert table.determined[hidden].eq("not determined").all()
    assert table.determined[["mass", "center x", "center z", "Iyy"]].eq("yes").all()
    assert table.value["mass"] == pytest.approx(MASS, rel=0.02)


def test_frames_that_contradict_the_training_are_named(caplog):
    """With a load; right frames stay silent, and a removed load has a negative mass."""
    structure = RigidChain(ARM)
    model = KnownMechanics(statistics(2), structure, start="generic", friction=CoulombFriction)
    heavy = (MASS, CENTER, INERTIA)
    without, loaded = recording(0), recording(1000, heavy)
    solver = LeastSquares(cutoff=6.0, rollouts=False, samples=1000)
    solver.fit(model, [without])
    flip = torch.tensor([1.0, -1.0]).double()
    q, v, u = loaded.q, loaded.v, loaded.u
    frames = {
        "right": (q, v, u),
        "reversed": (q, v, -u),
        "one reversed": (q, v, flip * u),
        "degrees": (180 / torch.pi * q, 180 / torch.pi * v, u),
        "exchanged": (q, v, u.flip(1)),
        "homed elsewhere": (q + 0.3, v, u),
        "20 ms late": (q, v, u.roll(2, 0)),
    }
    for name, (*state, force) in frames.items():
        caplog.clear()
        frame = Trajectory(*state, Signal(loaded.t, force))
        table = identify_payload(model, [without], [frame], cutoff=6.0, samples=1000)
        assert ("no load explains" in caplog.text) == (name != "right"), name
        assert (table.determined == "contradicted").all() == (name != "right"), name
    solver.fit(model, [loaded])
    table = identify_payload(model, [loaded], [without], cutoff=6.0, samples=1000)
    assert "its mass is at most -0.8" in caplog.text
    assert table.value[0] == pytest.approx(-MASS, rel=0.02)


@pytest.mark.slow
def test_the_intervals_contain_the_truth():
    inside = []
    for seed in range(20):
        table = identified(10 + seed, (MASS, CENTER, INERTIA))[:10]
        inside.append((table.low <= TRUTH) & (table.high >= TRUTH))
    assert np.mean(inside) > 0.8
    assert np.mean([row[0] for row in inside]) > 0.8
