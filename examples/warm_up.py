"""Follow the friction of an arm while it warms up.

python examples/warm_up.py [--figure warm_up.png]
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
parser.add_argument("--figure", default="warm_up.png")
args = parser.parse_args()
arm = RigidChain(str(Path(__file__).with_name("double_pendulum.urdf")))
names = {x: [f"{x}_{joint}" for joint in arm.joint_names] for x in ("q", "v", "u")}


def log(seconds, seed, friction):
    """Sines of the arm; the friction is a factor at each time."""
    generator = np.random.default_rng(seed)
    t = np.arange(0, seconds, 0.01)
    w = 2 * np.pi * np.array([0.31, 0.53, 0.97])
    phase = t[:, None, None] * w + generator.uniform(0, 6, (2, 3))
    q, v = 0.4 * np.sin(phase).sum(-1), 0.4 * (w * np.cos(phase)).sum(-1)
    a = -0.4 * (w**2 * np.sin(phase)).sum(-1)
    tau = arm.rigid_force(*map(torch.from_numpy, (q, v, a))).numpy()
    tau += friction(t)[:, None] * (0.3 * v + 0.2 * np.sign(v))
    tau += 0.02 * generator.normal(size=tau.shape)
    columns = [name for part in names.values() for name in part]
    return pd.DataFrame(np.hstack([q, v, tau]), columns=columns).assign(t=t)


cold, warming = log(40, 0, np.ones_like), log(120, 1, lambda t: 0.6 + 0.4 * np.exp(-t / 40))
model = partial(KnownMechanics, structure=arm, friction=CoulombFriction)
solver = LeastSquares(cutoff=6.0, rollouts=False)
run = pinn_dyn.fit(cold, **names, model=model, optimizer=solver)

result = run.adapt(warming)
for name, rows in result.table.groupby("name", sort=False):
    last = rows.iloc[-1]
    print(f"{name}: {last.start:.3f} -> {last.value:.3f} ({last.low:.3f} to {last.high:.3f})")
result.save(args.figure)
