"""Identification of a spring in a joint, from torques in closed form."""

import numpy as np
import pytest
import torch

from pinn_dyn.data.windows import draw_windows
from pinn_dyn.identification.constants import constants_table
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares

ARM = """<robot name="arm"><link name="base"/><link name="arm"><inertial>
    <origin xyz="0 0 -0.4"/><mass value="2.0"/>
    <inertia ixx="0.03" iyy="0.03" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="shoulder" type="revolute"><parent link="base"/><child link="arm"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="90" velocity="9"/></joint></robot>"""
STIFFNESS, REST = 30.0, 0.4  # Nm/rad, rad


def sprung_arm():
    """20 s of tau = I a + m g c sin q + d v + k (q - r), with noise."""
    t, noise = np.arange(2000) / 100, np.random.default_rng(0).normal(size=(3, 2000))
    phases = np.outer([0.2, 0.5, 0.9], 2 * np.pi * t) + np.array([[0.3], [1.1], [2.0]])
    size, rate = np.array([0.8, 0.3, 0.15]), 2 * np.pi * np.array([0.2, 0.5, 0.9])
    q, v, a = size @ np.sin(phases), size * rate @ np.cos(phases), -size * rate**2 @ np.sin(phases)
    torque = 0.35 * a + 2 * 9.81 * 0.4 * np.sin(q) + 0.5 * v + STIFFNESS * (q - REST)
    values = q + 1e-4 * noise[0], v + 1e-3 * noise[1], torque + 0.1 * noise[2]
    q, v, u = (torch.from_numpy(x[:, None]) for x in values)
    return Trajectory(q, v, Signal(torch.from_numpy(t), u))


def fitted(run, **settings):
    statistics = draw_windows([run], count=150, steps=5, stride=2, seed=0).statistics()
    model = KnownMechanics(statistics, RigidChain(ARM), start="prior", **settings)
    fit = LeastSquares(cutoff=6.0, rollouts=False, samples=300).fit(model, [run])
    return fit, constants_table(model, fit).set_index("name")


def test_least_squares_identifies_stiffness_and_rest_angle_of_a_joint():
    run = sprung_arm()
    plain, _ = fitted(run)
    fit, table = fitted(run, springs=["shoulder"])
    assert fit.residual < 0.1 * plain.residual
    for name, unit, truth in (
        ("spring stiffness of shoulder", "Nm/rad", STIFFNESS),
        ("rest angle of shoulder", "rad", REST),
    ):
        row = table.loc[name]
        assert row["value"] == pytest.approx(truth, rel=0.05), name
        assert row["low"] < truth < row["high"], name
        assert row["unit"] == unit
    assert "torque offset of shoulder" not in table.index
