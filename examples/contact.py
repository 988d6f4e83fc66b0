"""Find a push at the hand of a Panda in the torques of its joints, and its force.

python examples/contact.py [--figure contact.png]
"""

import argparse
from functools import partial

import numpy as np
import pandas as pd
import torch

import pinn_dyn
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--figure", default="contact.png")
args = parser.parse_args()

joints = [f"panda_joint{k}" for k in (1, 2, 4)]
arm = RigidChain("franka_panda/panda.urdf", joints=joints, tip="panda_hand")
names = {signal: [f"{signal}{k}" for k in (1, 2, 4)] for signal in ("q", "v", "tau")}


def log(seconds, seed, force=(0.0, 0.0, 0.0)):
    """Sines of the arm with friction and noise, and a force in N on the hand from 4.0 to 4.3 s."""
    generator = np.random.default_rng(seed)
    t = np.arange(0, seconds, 0.005)
    frequencies = 2 * np.pi * np.array([0.13, 0.29, 0.53])
    phase = t[:, None, None] * frequencies + generator.uniform(0, 6, (3, 3))
    q = np.array([0.0, 0.4, -1.6]) + (0.4 / frequencies * np.sin(phase)).sum(-1)
    v, a = 0.4 * np.cos(phase).sum(-1), -0.4 * (frequencies * np.sin(phase)).sum(-1)
    tau = arm.rigid_force(*map(torch.from_numpy, (q, v, a))).numpy() + 2 * v + 1.5 * np.sign(v)
    pushed = (t > 4.0) & (t <= 4.3)
    jacobian = arm.tip_jacobian(torch.from_numpy(q[pushed])).numpy()[:, :3]
    tau[pushed] -= jacobian.swapaxes(1, 2) @ np.array(force)
    v, tau = v + 1e-3 * generator.normal(size=v.shape), tau + 0.05 * generator.normal(size=v.shape)
    columns = [name for signal in names.values() for name in signal]
    return pd.DataFrame(np.hstack([q, v, tau]), columns=columns).assign(t=t)


free, pushed = log(60, 0), log(10, 1, force=(6.0, -9.0, 8.0))
model = partial(KnownMechanics, structure=arm, friction=CoulombFriction)
solver = LeastSquares(cutoff=6.0, rollouts=False)
run = pinn_dyn.fit(free, q=names["q"], v=names["v"], u=names["tau"], model=model, optimizer=solver)

result = run.external_torque(pushed, bandwidth=25.0, link="panda_hand")
print(result.contacts.round(2).to_string(index=False))
held = pushed.t.between(4.15, 4.3)
print("force [N]:", result.table.loc[held, ["fx", "fy", "fz"]].mean().round(1).tolist())
result.save(args.figure)

run.export("contact.c", "external_torque")  # for the controller of the robot
