"""Simulate a soft arm, learn it from its motions, compare learned and true matrices.

python examples/simulate_and_learn.py [--steps 2000]
"""

import argparse
from functools import partial

import numpy as np
import torch

import pinn_dyn
from pinn_dyn.data import DynamicsData
from pinn_dyn.mechanics import rollout
from pinn_dyn.training import MidpointLoss

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=2000, help="steps of the optimizer")
parser.add_argument("--duration", type=float, default=4.0, help="length of each motion, s")
args = parser.parse_args()

# 20 motions at 500 Hz, simulated on the first call. The midpoint loss needs a high rate.
source = pinn_dyn.dataset(
    "soft_arm_1",
    duration=args.duration,
    step=0.002,
    train_initial_states=5,
    train_inputs=4,
    validation=2,
    test=1,
)
windows = partial(DynamicsData, stride=1)
model = pinn_dyn.train(source, "lnn", loss=MidpointLoss, data=windows, steps=args.steps)
print(model)

# A motion of the true arm that is not part of the training data.
arm = pinn_dyn.SoftArm(segments=1).double()
t = torch.arange(0, 2, 0.01, dtype=torch.float64)
u = torch.stack([torch.sin(4 * t), torch.cos(3 * t), torch.full_like(t, -1.15)], dim=1)
start = torch.tensor([0.5, -0.5, 0.3, 0.0, 0.0, 0.0], dtype=torch.float64)
true = rollout(arm.velocity_derivative, start, t, pinn_dyn.Signal(t, u)).numpy()
error = np.abs(model.predict(start, u, t) - true)[:, :3].mean(axis=0)
print("mean error over 2 s:", dict(zip(model.labels, error.round(4), strict=True)))

# Motions determine the terms up to a common matrix, and therefore A^-1 M.
for name, terms in (("learned", model.terms(start[:3])), ("true", arm.terms(start[:3]))):
    print(f"A^-1 M, {name}:", np.linalg.solve(np.asarray(terms.A), np.asarray(terms.M)), sep="\n")
