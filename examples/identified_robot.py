"""Identify an arm, write its URDF, and compute the same torques in Pinocchio (pip install pin).

python examples/identified_robot.py [--urdf examples/double_pendulum.urdf]
"""

import argparse
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pinocchio
import torch

import pinn_dyn
from pinn_dyn.models import CoulombFriction, KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--urdf", default=str(Path(__file__).with_name("double_pendulum.urdf")))
arm = RigidChain(parser.parse_args().urdf)

# A log: sines, and the torques of an arm of 1.5 times the masses, with friction and noise.
t = np.arange(0, 30, 0.01)
phase = np.outer(t, [0.71, 1.13, 1.97]) * 2 * np.pi
q = 0.5 * np.stack([np.sin(phase).sum(1), np.cos(phase).sum(1)], axis=1)
v, a = np.gradient(q, t, axis=0), np.gradient(np.gradient(q, t, axis=0), t, axis=0)
tau = 1.5 * arm.rigid_force(*map(torch.from_numpy, (q, v, a))).numpy() + 0.1 * v
tau += np.random.default_rng(0).normal(size=q.shape) * 0.01
names = {name: [f"{name}_{joint}" for joint in arm.joint_names] for name in ("q", "v", "tau")}
columns = [name for signal in names.values() for name in signal]
log = pd.DataFrame(np.hstack([q, v, tau]), columns=columns).assign(t=t)

model = partial(KnownMechanics, structure=arm, friction=CoulombFriction)
solver = LeastSquares(cutoff=6.0, rollouts=False)
run = pinn_dyn.fit(log, q=names["q"], v=names["v"], u=names["tau"], model=model, optimizer=solver)
path = run.export("identified.urdf")

robot = pinocchio.buildModelFromUrdf(str(path))
robot.armature = run.system.rotor_inertia().numpy()  # a URDF has no field for it
states = [np.array(x) for x in ([0.3, -0.5], [1.0, 2.0], [3.0, -4.0])]
position = pinocchio.integrate(robot, pinocchio.neutral(robot), states[0])
torque = pinocchio.rnea(robot, robot.createData(), position, *states[1:])
torque += robot.damping * states[1]
speed = torch.from_numpy(states[1])
dry = run.system.friction(speed).numpy() - run.system.constant_force().numpy()
print("Pinocchio:", (torque + dry).round(4))
print("the model:", run.inverse_dynamics(*states).round(4))
