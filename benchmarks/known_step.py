"""Time of a training step of known mechanics, beside that of the Lagrangian network for one robot.

A step is: one RK4 step of a batch, the increment loss, its gradient; no optimizer. The models are
those of experiment=panda/known, panda/known_and_network and panda/lnn, N = 7, compiled as
compile=true does it in a training of 5,000 steps (the state derivative) and of 20,000 (all of it).
They take turns, round by round; the clock is the processor time of this process, on one thread.

    python benchmarks/known_step.py                       # the table of README.md
    python benchmarks/known_step.py --rounds 3 --eager    # without compiling, no file
"""

from __future__ import annotations

import argparse
import csv
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from training_step import STEP, make_windows

from pinn_dyn.app.build import build_model
from pinn_dyn.app.config import composed
from pinn_dyn.app.provenance import provenance
from pinn_dyn.mechanics.compilation import STEPS_FOR_PROGRAM
from pinn_dyn.models import Statistics
from pinn_dyn.training import IncrementLoss, ParameterVector
from pinn_dyn.training.gradients import Compiled, Eager

SIZE = 7
RESULT = Path(__file__).parent / "results" / "known_step.csv"
MODELS = ("lnn", "known", "known_and_network")
STEPS = {"derivative": 0, "whole": STEPS_FOR_PROGRAM}


def scales() -> Statistics:
    """Of standard normal data."""
    one = torch.ones(SIZE, dtype=torch.float64)
    increment = torch.cat([STEP * one, STEP * one])[None]
    return Statistics(
        0 * one, one, -5 * one, 5 * one, one, one, 0 * one, one, increment, increment, STEP
    )


def step_of(name: str, compiled: str, batch: int) -> Callable[[], float]:
    """Loss and gradient of the model of an experiment on one batch."""
    torch.manual_seed(0)
    words = [f"experiment=panda/{name}", "name=benchmark", f"model_name={name}"]
    model = build_model(composed("train", words), scales()).train()
    loss, vector = IncrementLoss(scales(), model), ParameterVector(model.parameters())
    windows = make_windows(SIZE, batch, torch.float32)
    if compiled == "eager":
        engine: Compiled | Eager = Eager(loss, model, vector)
    else:
        engine = Compiled(loss, model, vector, STEPS[compiled])
    return lambda: float(engine(windows)[0])


def seconds_of(step: Callable[[], float], count: int) -> float:
    """Processor time of a step among its like."""
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
    parser.add_argument("--eager", action="store_true", help="smoke run without a compiler")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    ways = ["eager"] if arguments.eager else ["eager", *STEPS]
    steps = {(name, way): step_of(name, way, arguments.batch) for way in ways for name in MODELS}
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
    if not arguments.eager:
        with RESULT.open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
        print(f"wrote {RESULT}")


if __name__ == "__main__":
    main()
