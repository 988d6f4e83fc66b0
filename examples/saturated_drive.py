"""Fit an arm to the commands of a drive that saturates, with and without its torque-speed curve.

python examples/saturated_drive.py
"""

from functools import partial

import numpy as np
import pandas as pd

import pinn_dyn
from pinn_dyn.models import CoulombFriction, DriveLimits, KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares

ARM = """<robot name="arm"><link name="base"/><link name="arm"><inertial>
    <origin xyz="0 0 -0.3"/><mass value="1.0"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="hinge" type="continuous"><parent link="base"/><child link="arm"/>
    <axis xyz="0 1 0"/></joint></robot>"""
LIMIT, STALL, SPEED = 3.0, 6.0, 9.0  # Nm, Nm, rad/s

# A controller follows sines that ask for more than the drive has. The log holds its commands.
rows, q, v = [], 0.0, 0.0
for t in np.arange(0, 40, 0.005):
    goal = 0.9 * np.sin(2 * np.pi * t * np.array([0.23, 0.51, 0.97])).sum()
    command = 40 * (goal - q) - 3 * v
    rows.append({"t": t, "q": q, "v": v, "tau": command})
    for _ in range(5):  # steps of 1 ms
        most, least = (min(LIMIT, max(STALL * (1 - w / SPEED), 0)) for w in (v, -v))
        torque = np.clip(command, -least, most) - 0.2 * np.tanh(v / 0.02) - 0.15 * v
        v += 0.001 * (torque - 0.3 * 9.81 * np.sin(q)) / 0.1
        q += 0.001 * v
log = pd.DataFrame(rows)

curve = partial(DriveLimits, limit=LIMIT, stall=STALL, no_load_speed=SPEED)
solver = LeastSquares(cutoff=8.0, rollouts=False)
for name, limits in (("no limits", None), ("torque-speed curve", curve)):
    model = partial(
        KnownMechanics, structure=RigidChain(ARM), friction=CoulombFriction, limits=limits
    )
    run = pinn_dyn.fit(log, q="q", v="v", u="tau", model=model, optimizer=solver)
    _, _, _, mz = run.system.body_parameters()[0, :4].tolist()
    friction = float(run.system.viscous())
    print(f"{name}: m c = {-mz:.3f} kg m (0.300), viscous friction {friction:.3f} Nms/rad (0.150)")
