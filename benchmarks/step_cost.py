"""Compare the cost of a training step in two checkouts of the repository, side by side.

    git worktree add ../before <commit>
    python benchmarks/step_cost.py ../before .
    python benchmarks/step_cost.py . . --rounds 2    # a smoke run: all ratios are about 1

Each checkout runs in a process of its own on one core and one thread. The processes take turns,
round by round, and change their order in every round. A step is loss and gradient of a Lagrangian
network, with the model and the windows of ``training_step.py`` of the checkout. Times are processor
times; the ratio is the median over the rounds of the time in the second checkout over the time in
the first.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

WAYS = ("eager", "derivative", "program", "midpoint")


def serve(checkout: Path, size: int, batch: int, ways: list[str], count: int) -> None:
    """Time ``count`` steps of every way for each line of the standard input."""
    sys.path[:0] = [str(checkout), str(checkout / "benchmarks")]
    import torch
    from training_step import make_model, make_windows

    import pinn_dyn
    from pinn_dyn.mechanics.compilation import STEPS_FOR_PROGRAM
    from pinn_dyn.training import IncrementLoss, MidpointLoss, ParameterVector
    from pinn_dyn.training.gradients import Compiled, Eager

    assert Path(pinn_dyn.__file__).is_relative_to(checkout), pinn_dyn.__file__
    torch.set_num_threads(1)
    windows = make_windows(size, batch, torch.float32)
    engines = {}
    for way in ways:
        model, scales = make_model(size, torch.float32)
        loss = (MidpointLoss if way == "midpoint" else IncrementLoss)(scales, model)
        vector = ParameterVector(model.parameters())
        steps = 0 if way == "derivative" else STEPS_FOR_PROGRAM
        engine = Eager(loss, model, vector) if way == "eager" else None
        engines[way] = engine or Compiled(loss, model, vector, steps)
        engines[way](windows)  # compiles
    print("ready", flush=True)
    for _ in sys.stdin:
        times = {}
        for way, engine in engines.items():
            engine(windows)
            start = time.process_time()
            for _ in range(count):
                engine(windows)
            times[way] = 1e3 * (time.process_time() - start) / count
        print(json.dumps(times), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--size", type=int, default=3, help="number of coordinates")
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--count", type=int, default=20, help="steps in a round")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=WAYS)
    parser.add_argument("--serve", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
    checkouts = [options.before.resolve(), options.after.resolve()]
    if options.serve is not None:
        checkout = checkouts[options.serve]
        return serve(checkout, options.size, options.batch, options.ways, options.count)
    command = [sys.executable, "-P", *sys.argv, "--serve"]
    environment = {k: x for k, x in os.environ.items() if k != "PYTHONPATH"}
    workers = [
        subprocess.Popen(
            [*command, str(side)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        for side in (0, 1)
    ]
    for worker in workers:
        assert worker.stdout.readline() == "ready\n", "a checkout failed; see the message above"
    times: list[list[dict[str, float]]] = [[], []]
    for k in range(options.rounds):
        for side in (k % 2, 1 - k % 2):
            workers[side].stdin.write("\n")
            workers[side].stdin.flush()
            times[side].append(json.loads(workers[side].stdout.readline()))
    for worker in workers:
        worker.stdin.close()
        worker.wait()
    print("| step | before, ms | after, ms | after / before | quartiles |\n|---|---|---|---|---|")
    for way in options.ways:
        before, after = ([turn[way] for turn in turns] for turns in times)
        ratios = [b / a for a, b in zip(before, after, strict=True)]
        low, middle, high = statistics.quantiles(ratios, n=4)
        medians = f"{statistics.median(before):.3f} | {statistics.median(after):.3f}"
        print(f"| {way} | {medians} | {middle:.3f} | {low:.3f} to {high:.3f} |")


if __name__ == "__main__":
    main()
