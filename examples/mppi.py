"""Move a Panda with a payload by sampling predictive control (MPPI) on the model of its URDF.

python examples/mppi.py [--run runs/panda] [--duration 3]

256 input sequences are rolled out side by side in every control instant. The input is their mean,
weighted by exp(-cost / temperature) (Williams et al. 2017, "Information theoretic MPC"). MuJoCo
moves the arm, which holds 1 kg that the model does not know. Torques are clipped; speeds beyond
their limit cost. Install pinn_dyn[mujoco,envs].
"""

import argparse

import numpy as np
import torch

import pinn_dyn
from pinn_dyn.envs import ModelPlant
from pinn_dyn.systems import MujocoArm, RigidChain

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--run", help="folder of an identified Panda; the default is the URDF")
parser.add_argument("--duration", type=float, default=3.0, help="s")
args = parser.parse_args()
URDF, FINGERS = "franka_panda/panda.urdf", ["panda_finger_joint1", "panda_finger_joint2"]
SAMPLES, HORIZON, DT, TEMPERATURE = 256, 25, 0.02, 0.02
SPEED, NOISE, RISE = 1.0, 0.4, 0.06  # limit and noise of speeds, rad/s; rise time, s
TORQUE = np.array([87.0, 87, 87, 87, 12, 12, 12])

chain = RigidChain(URDF, locked_joints=FINGERS)
model = pinn_dyn.load(args.run).system if args.run else chain
robots = ModelPlant(model, step=DT / 2)
arm = MujocoArm(URDF, locked_joints=FINGERS, payload=1.0)
goal = np.array([0.5, 0.2, 0.4, -1.4, 0.2, 1.8, 0.6])
q, v = np.array([0.0, -0.4, 0.0, -2.0, 0.0, 1.6, 0.0]), np.zeros(7)
arm.set_state(q, v)
rng = np.random.default_rng(0)


def costs(q, v):
    """Cost ``(samples,)`` of a step: distance to the goal, and speed beyond its limit."""
    beyond = np.maximum(np.abs(v) - 0.9 * SPEED, 0)
    return np.square(q - goal).sum(1) + 20 * np.square(beyond).sum(1)


plan, speeds, torques = np.zeros((HORIZON, 7)), [], []  # desired speeds
for _ in range(round(args.duration / DT)):
    with torch.no_grad():
        here, now = torch.from_numpy(q), torch.from_numpy(v)
        M = model.mass_matrix(here).numpy() / RISE
        hold = model.inverse_dynamics(here, now, 0 * now).numpy()
    noise = NOISE * rng.normal(size=(SAMPLES, 5, 7)).repeat(HORIZON // 5, axis=1)
    wanted = np.clip(plan + noise, -0.9 * SPEED, 0.9 * SPEED)
    robots.start(*(torch.from_numpy(np.tile(x, (SAMPLES, 1))) for x in (q, v)))
    total, speed = np.zeros(SAMPLES), np.tile(v, (SAMPLES, 1))
    for target in wanted.swapaxes(0, 1):
        u = np.clip(hold + (target - speed) @ M, -TORQUE, TORQUE)
        position, speed = (x.numpy() for x in robots.advance(torch.from_numpy(u), DT))
        total += costs(position, speed)
    weights = np.exp(-(total - total.min()) / (TEMPERATURE * HORIZON))
    plan = np.tensordot(weights / weights.sum(), wanted, 1)
    u = np.clip(hold + (plan[0] - v) @ M, -TORQUE, TORQUE)
    for _ in range(round(DT / 0.001)):
        q, v = arm.step(u, 0.001)
    speeds.append(np.abs(v).max())
    torques.append(np.abs(u / TORQUE).max())
    plan = np.concatenate([plan[1:], 0 * plan[:1]])
print(f"distance to the goal: {np.abs(q - goal).max():.3f} rad")
print(f"largest speed: {max(speeds):.2f} rad/s, limit {SPEED:g} rad/s")
print(f"largest torque: {100 * max(torques):.0f} % of the limit")
