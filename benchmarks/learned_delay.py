"""Delays learned from a pendulum's log, true 30 ms: python -m benchmarks.learned_delay [steps]."""

import sys
from functools import partial

import torch

from pinn_dyn.data.logs import SavitzkyGolayVelocity
from pinn_dyn.data.windows import draw_windows
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import (
    ConstantCholesky,
    ConstantInput,
    LagrangianNetwork,
    LearnedDelay,
    NetworkPotential,
)
from pinn_dyn.training.losses import IncrementLoss
from tests.support.delayed_robots import log

TRUE = 0.03


def learned(noise: float, window: str, initial: float, seed: int, steps: int) -> float:
    """d in s after a training on windows of 50 ms of a log of 12 s at 100 Hz."""
    item = log("pendulum", seed, TRUE, noise=noise)
    ((item,), _) = SavitzkyGolayVelocity(window=window).apply(item)
    t, q, v, u = (torch.from_numpy(x.copy()) for x in (item.t, item.q, item.v, item.u))
    motion = Trajectory(q, v, Signal(t, u))
    windows = draw_windows([motion], count=1000, steps=5, stride=1, seed=seed, history=0.1)
    scales = windows.statistics()
    torch.manual_seed(seed)
    model = LagrangianNetwork(
        scales,
        ConstantCholesky,
        partial(NetworkPotential, hidden=[16], activation="tanh"),
        ConstantCholesky,
        ConstantInput,
        angles=[0],
        delay=LearnedDelay(0.1, initial),
    ).float()
    loss = IncrementLoss(scales, model)
    windows = windows.to(torch.device("cpu"), torch.float32)
    optimizer = torch.optim.AdamW(model.parameters(), lr=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 0.01, total_steps=steps)
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        optimizer.zero_grad()
        loss(model, windows[torch.randint(1000, (128,), generator=generator)]).backward()
        optimizer.step()
        schedule.step()
    return model.learned_figures()["input_delay_seconds"]


def main(steps: int) -> None:
    """Print the learned delay for each noise, filter of the velocity, start and seed."""
    for noise, window in ((0.0, "0.11 s"), (1e-4, "0.11 s"), (1e-3, "0.11 s"), (1e-3, "0.25 s")):
        for initial in (0.0, TRUE):
            found = [1e3 * learned(noise, window, initial, seed, steps) for seed in range(2)]
            print(
                f"noise {noise:g} of the range, v over {window}, from {1e3 * initial:.0f} ms: "
                f"{', '.join(f'{d:.1f}' for d in found)} ms",
                flush=True,
            )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 500)
