"""Simulate a soft arm, learn it from its motions, compare learned and true matrices.

python examples/simulate_and_learn.py [--steps 2000] [overrides]
"""

import argparse

import numpy as np
import torch

import pinn_dyn
from pinn_dyn.mechanics import rollout

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=2000, help="of the optimizer")
args, overrides = parser.parse_known_args()

# 20 motions of 4 s, simulated on the first call, for the loss of cheap steps at a high rate.
small = ["duration=4", "step=0.002", "train_initial_states=5", "train_inputs=4", "validation=2"]
own = [*(f"dataset.{word}" for word in small), "loss=midpoint", "data.stride=1"]
model = pinn_dyn.fit("soft_arm_1", model="lnn", steps=args.steps, overrides=[*own, *overrides])
print(model)

# A motion of the true arm that no training saw, by the same roll-out.
arm = pinn_dyn.SoftArm(segments=1).double()
t = torch.arange(0, 2, 0.01, dtype=torch.float64)
u = torch.stack([torch.sin(4 * t), torch.cos(3 * t), torch.full_like(t, -1.15)], dim=1)
start = torch.tensor([0.5, -0.5, 0.3, 0.0, 0.0, 0.0], dtype=torch.float64)
true = rollout(arm.velocity_derivative, start, t, pinn_dyn.Signal(t, u)).numpy()
error = np.abs(model.predict(start, u, t) - true)[:, :3].mean(axis=0)
print("mean error over 2 s:", dict(zip(model.labels, error.round(4), strict=True)))

# Motions leave the terms free up to one common matrix: A^-1 M is what they can tell.
for name, terms in (("learned", model.terms(start[:3])), ("true", arm.terms(start[:3]))):
    print(f"A^-1 M, {name}:", np.linalg.solve(np.asarray(terms.A), np.asarray(terms.M)), sep="\n")
