"""Time of a training step of known mechanics, beside that of the Lagrangian network for one robot.

A step is one RK4 step of a batch, the increment loss and its gradient; no optimizer. The models are
the Lagrangian network of experiment=panda, the rigid chain of the Panda and their sum (N = 7). They
run eager and compiled, as compile=true does in a training of 5,000 steps (the state derivative) or
of 20,000 steps (the whole step). The models take turns, round by round. Times are processor times
of this process on one thread.

    python benchmarks/known_step.py                       # the table of README.md
    python benchmarks/known_step.py --ways eager --rounds 2 --output /dev/null   # a smoke run
"""

from __future__ import annotations

import argparse
import csv
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from configured import build_model
from training_step import STEP, make_windows

from pinn_dyn.app.config import composed
from pinn_dyn.mechanics.compilation import STEPS_FOR_PROGRAM
from pinn_dyn.models import Statistics
from pinn_dyn.run.provenance import provenance
from pinn_dyn.training import IncrementLoss, ParameterVector
from pinn_dyn.training.gradients import Compiled, Eager

SIZE = 7
RESULT = Path(__file__).parent / "results" / "known_step.csv"
PANDA = ["dataset=panda", "name=benchmark", "model_name=benchmark"]
CHAIN = "structure.urdf=franka_panda/panda.urdf"
FINGERS = "structure.locked_joints=[panda_finger_joint1,panda_finger_joint2]"
MODELS = {
    "lnn": ["experiment=panda", "loss=increment"],
    "known": ["model=known", "~model/friction", f"model.{CHAIN}", f"model.{FINGERS}"],
    "known_and_network": [
        "model=known_and_network",
        "~model/friction@model.known.friction",
        f"model.known.{CHAIN}",
        f"model.known.{FINGERS}",
    ],
}
WAYS = {"eager": None, "derivative": 0, "whole": STEPS_FOR_PROGRAM}
"""Compilation, and the number of training steps that selects it."""


def scales() -> Statistics:
    """Return the scales of standard normal data."""
    one = torch.ones(SIZE, dtype=torch.float64)
    increment = torch.cat([STEP * one, STEP * one])[None]
    return Statistics(
        0 * one, one, -5 * one, 5 * one, one, one, 0 * one, one, increment, increment, STEP
    )


def step_of(name: str, compiled: str, batch: int) -> Callable[[], float]:
    """Return a function for loss and gradient of a model on one batch."""
    torch.manual_seed(0)
    model = build_model(composed("train", [*MODELS[name], *PANDA]), scales()).train()
    loss, vector = IncrementLoss(scales(), model), ParameterVector(model.parameters())
    windows = make_windows(SIZE, batch, torch.float32)
    steps = WAYS[compiled]
    engine = Eager(loss, model, vector) if steps is None else Compiled(loss, model, vector, steps)
    return lambda: float(engine(windows)[0])


def seconds_of(step: Callable[[], float], count: int) -> float:
    """Return the processor time of a step, s."""
    step()
    start = time.process_time()
    for _ in range(count):
        step()
    return (time.process_time() - start) / count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--count", type=int, default=10, help="steps in a round")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=["eager", "derivative"])
    parser.add_argument("--output", type=Path, default=RESULT)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    steps = {
        (name, way): step_of(name, way, arguments.batch)
        for way in arguments.ways
        for name in MODELS
    }
    for (name, way), step in steps.items():
        start = time.perf_counter()
        step()
        print(f"{name}, {way}: first step {time.perf_counter() - start:.0f} s", flush=True)
    times: dict[tuple[str, str], list[float]] = {key: [] for key in steps}
    for _ in range(arguments.rounds):
        for key, step in steps.items():
            times[key].append(seconds_of(step, arguments.count))
    record = {key: provenance()[key] for key in ("hardware", "torch", "commit")}
    rows = []
    for (name, way), values in times.items():
        beside = [own / lnn for own, lnn in zip(values, times["lnn", way], strict=True)]
        row = {"coordinates": SIZE, "batch": arguments.batch, "model": name, "compiled": way}
        row |= {"rounds": len(values), "cpu_ms": round(1e3 * statistics.median(values), 2)}
        row |= {"x_lnn": round(statistics.median(beside), 2)}
        row |= {"smallest": round(min(beside), 2), "largest": round(max(beside), 2)}
        rows.append(row | record)
        print(f"| {way} | {name} | {row['cpu_ms']} | {row['x_lnn']} |", flush=True)
    with arguments.output.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    print(f"wrote {arguments.output}")


if __name__ == "__main__":
    main()
