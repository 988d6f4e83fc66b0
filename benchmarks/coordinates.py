"""How the cost grows with the number of coordinates: soft arms of 1 to 16 segments.

    python benchmarks/coordinates.py           # all arms that results/coordinates.csv lacks
    python benchmarks/coordinates.py 4         # those of up to so many segments

A row for each arm, N = 3 coordinates a segment: an evaluation of its equation of motion for 16
states (float64), a short data set of 16 motions that begin at rest and hang, and a training step of
a Lagrangian network, loss and gradient of the midpoint loss at batch 256, eager and compiled, after
so many seconds of compiling. Steps are the best of five; all is seconds of the processor, the
compiler's included.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable

import numpy as np
import torch
from training_loop import RESULTS, append, rows_of
from training_step import make_model, make_windows

from pinn_dyn.data.simulation import simulate
from pinn_dyn.mechanics.compilation import STEPS_FOR_PROGRAM
from pinn_dyn.run.provenance import provenance
from pinn_dyn.systems import SoftArm
from pinn_dyn.training import MidpointLoss, ParameterVector
from pinn_dyn.training.gradients import Compiled, Eager

BATCH = 256
SEGMENTS = (1, 2, 4, 8, 16)
MOTIONS, DURATION, SAMPLE = 16, 0.1, 2e-3  # of the short data set; s


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


def data_set(segments: int) -> float:
    """Seconds that the short data set takes, uncompiled."""
    # Stiff enough to carry many segments; the usual constants are those of the paper's one.
    stiffness, damping = [2, 2, 50] * segments, [0.005, 0.005, 0.05] * segments
    arm = SoftArm(segments, mass=0.05, stiffness=stiffness, damping=damping)
    q = 0.02 * np.random.default_rng(0).standard_normal((MOTIONS, arm.num_coordinates))
    t = np.arange(0, DURATION, SAMPLE)
    start = time.process_time()
    simulate(arm, q, 0 * q, lambda times: np.zeros((MOTIONS, len(times), arm.num_inputs)), t)
    return time.process_time() - start


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
    """Measure the arms that the file lacks; each row is written at once."""
    torch.set_num_threads(1)
    largest = int(sys.argv[1]) if len(sys.argv) > 1 else SEGMENTS[-1]
    record = {key: provenance()[key] for key in ("hardware", "torch", "commit")}
    path = RESULTS / "coordinates.csv"
    there = {row["coordinates"] for row in rows_of(path)}
    for segments in SEGMENTS:
        size = 3 * segments
        if segments > largest or str(size) in there:
            continue
        row: dict[str, object] = {"coordinates": size}
        row["equation_ms"] = round(equation(segments), 2)
        row["data_set_s"] = round(data_set(segments), 2)
        row["eager_ms"] = round(training(Eager, size)[0], 2)
        compiled, first = training(Compiled, size)
        row |= {"compiled_ms": round(compiled, 2), "compiling_s": round(first, 1), **record}
        append(row, path)
        print(row, flush=True)


if __name__ == "__main__":
    main()
