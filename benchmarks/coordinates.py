"""How the cost grows with the number of coordinates: soft arms of 1 to 16 segments.

    python benchmarks/coordinates.py           # the table of README.md
    python benchmarks/coordinates.py 4         # arms of up to so many segments

A row for each arm, N = 3 coordinates a segment: an evaluation of its equation of motion for 16
states (float64, what simulating its data costs), and a training step of a Lagrangian network,
loss and gradient of the midpoint loss at batch 256, eager and compiled, after so many seconds of
compiling. Steps are the best of five; all is seconds of the processor, the compiler's included.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

import torch
from training_step import make_model, make_windows

from pinn_dyn.mechanics.compilation import STEPS_FOR_PROGRAM
from pinn_dyn.systems import SoftArm
from pinn_dyn.training import MidpointLoss, ParameterVector
from pinn_dyn.training.gradients import Compiled, Eager

BATCH = 256
SEGMENTS = (1, 2, 4, 8, 16)


def milliseconds(step: Callable[[], object]) -> float:
    """Of the processor, the best of five."""
    best = float("inf")
    for _ in range(5):
        start = time.process_time()
        step()
        best = min(best, time.process_time() - start)
    return 1e3 * best


def equation(segments: int) -> float:
    """Milliseconds of an evaluation of the true equation of motion."""
    arm = SoftArm(segments)
    q, v, u = (torch.randn(3, 16, arm.num_coordinates, dtype=torch.float64) * 0.1).unbind()
    return milliseconds(lambda: arm.forward_dynamics(q, v, u))


def training(kind: type[Eager | Compiled], size: int) -> tuple[float, float]:
    """Milliseconds of a step, and seconds that the first one takes."""
    torch._dynamo.reset()
    model, scales = make_model(size, torch.float32)
    windows = make_windows(size, BATCH, torch.float32)
    loss, vector = MidpointLoss(scales, model), ParameterVector(model.parameters())
    steps = (STEPS_FOR_PROGRAM,) if kind is Compiled else ()
    engine = kind(loss, model, vector, *steps)
    start = sum(os.times()[:4])  # of this process and of the compilers that it starts
    engine(windows)
    first = sum(os.times()[:4]) - start
    return milliseconds(lambda: engine(windows)), first


def main() -> None:
    """Print the rows."""
    torch.set_num_threads(1)
    largest = int(sys.argv[1]) if len(sys.argv) > 1 else SEGMENTS[-1]
    print("|  N | equation, ms | eager, ms | compiled, ms | compiling, s |\n|---|---|---|---|---|")
    for segments in (count for count in SEGMENTS if count <= largest):
        size = 3 * segments
        eager, _ = training(Eager, size)
        compiled, first = training(Compiled, size)
        print(
            f"| {size} | {equation(segments):.2f} | {eager:.1f} | {compiled:.1f} | {first:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
