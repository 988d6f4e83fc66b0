"""Draw robots that explain a log equally well, and write them as MJCF for a simulator.

python examples/randomized_robots.py [--draws 5]    writes the folder draws
"""

import argparse
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import torch

import pinn_dyn
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--draws", type=int, default=5)
args = parser.parse_args()
arm = RigidChain(str(Path(__file__).with_name("double_pendulum.urdf")))

# A log: sines, and the torques of the arm, with friction and noise.
t = np.arange(0, 30, 0.01)
phase = np.outer(t, [0.71, 1.13, 1.97]) * 2 * np.pi
q = 0.5 * np.stack([np.sin(phase).sum(1), np.cos(phase).sum(1)], axis=1)
v, a = np.gradient(q, t, axis=0), np.gradient(np.gradient(q, t, axis=0), t, axis=0)
tau = arm.rigid_force(*map(torch.from_numpy, (q, v, a))).numpy() + 0.1 * v
tau += np.random.default_rng(0).normal(size=q.shape) * 0.05
log = pd.DataFrame(np.hstack([q, v, tau]), columns=["q1", "q2", "v1", "v2", "tau1", "tau2"])
model = partial(KnownMechanics, structure=arm, friction=CoulombFriction)
solver = LeastSquares(cutoff=6.0, rollouts=False)
names = {"q": ["q1", "q2"], "v": ["v1", "v2"], "u": ["tau1", "tau2"]}
run = pinn_dyn.fit(log.assign(t=t), **names, model=model, optimizer=solver)

robots = run.sample(args.draws, seed=1)  # models, such as one per copy of an environment
table = pd.read_csv(run.export("draws/pendulum.xml", samples=args.draws, seed=1))
for link in ("link1", "link2"):
    mass = table[f"mass of {link} [kg]"]
    spread = 100 * mass.std() / mass.mean()
    print(f"mass of {link}: {mass.min():.2f} to {mass.max():.2f} kg, {spread:.1f} %")
state = [torch.from_numpy(x[::50]) for x in (q, v, a)]
torques = torch.stack([robot.inverse_dynamics(*state) for robot in robots])
share = 100 * torques.std(0).square().mean().sqrt() / torques.mean(0).std()
print(f"torque: {share:.2f} % of its spread in the log")
