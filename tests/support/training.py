"""Small trainings: a data source, models and a trainer."""

from functools import cache, partial

import lightning as L
import numpy as np
import torch

from pinn_dyn.data import DataSource, Splits, simulate
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import (
    AccelerationMLP,
    ConstantCholesky,
    ConstantInput,
    HamiltonianNetwork,
    LagrangianNetwork,
    NetworkPotential,
    NextStateMLP,
    Positive,
)
from pinn_dyn.testing import damped_oscillators

HEADS = dict(
    potential=partial(NetworkPotential, hidden=[8]),
    damping=partial(ConstantCholesky, positivity=Positive(floor=0.0)),
    input=ConstantInput,
)
MODELS = {
    "lnn": lambda statistics: LagrangianNetwork(statistics, ConstantCholesky, **HEADS),
    "hnn": lambda statistics: HamiltonianNetwork(statistics, ConstantCholesky, **HEADS),
    "acceleration": lambda statistics: AccelerationMLP(statistics, [16]),
    "next state": lambda statistics: NextStateMLP(statistics, [16]),
}


class Oscillators(DataSource):
    """Trajectories of two coupled damped masses."""

    def __init__(self, splits):
        self.splits = splits

    def load(self):
        return self.splits


@cache
def make_splits():
    """Six motions, four of them for training."""
    system = damped_oscillators().requires_grad_(False)
    rng = np.random.default_rng(0)
    t = np.linspace(0, 2, 101)
    phase = rng.uniform(0, 6, (6, 1, 1))

    def signal(s):
        return np.sin(3 * s[:, None] + phase)

    q, v = simulate(system, *rng.uniform(-1, 1, (2, 6, 2)), signal, t)
    q, v, u = (torch.from_numpy(np.ascontiguousarray(x)) for x in (q, v, signal(t)))
    made = [
        Trajectory(q[k], v[k], Signal(torch.from_numpy(t), u[k]), momentum=system.momentum)
        for k in range(6)
    ]
    return Splits(made[:4], made[4:5], made[5:])


def make_trainer(folder, *, max_epochs, accelerator="cpu", **extra):
    return L.Trainer(
        accelerator=accelerator,
        max_epochs=max_epochs,
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        inference_mode=False,
        default_root_dir=folder,
        **extra,
    )
