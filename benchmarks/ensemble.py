"""Ten seeds in one batched training against one seed, side by side.

    python benchmarks/ensemble.py                     # the table in benchmarks/README.md
    python benchmarks/ensemble.py --loss midpoint --output benchmarks/results/ensemble_midpoint.csv
    python benchmarks/ensemble.py --optimizer soap --output benchmarks/results/ensemble_soap.csv
    python benchmarks/ensemble.py --quick             # a smoke run

A step is all that a training does at a step, but for the trainer's own loop: pick the batch from
the windows in memory, loss, backward pass, clip, optimizer, schedule. N = 3, as the one-segment
arm, head sizes of conf/model, 8,000 windows of one step, float32, compiled: an ensemble as a whole,
member by member; one seed its derivative alone in a training of up to 20,000 steps, and as a whole
in a longer one (compile=auto).
"""

from __future__ import annotations

import argparse
import csv
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from long_rollout import make_model
from torch import Tensor
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import OneCycleLR

from pinn_dyn.data.windows import BatchSampler, MemberSampler, WindowLoader, Windows
from pinn_dyn.ensembles import Ensemble
from pinn_dyn.ensembles.gradients import CompiledMembers
from pinn_dyn.ensembles.learner import MemberSOAP
from pinn_dyn.mechanics import Predictor, Signal
from pinn_dyn.mechanics.compilation import STEPS_FOR_PROGRAM
from pinn_dyn.run.provenance import provenance
from pinn_dyn.training import SOAP, IncrementLoss, MidpointLoss, ParameterVector
from pinn_dyn.training.adamw import clipped
from pinn_dyn.training.gradients import Compiled, Eager, Engine

HERE = Path(__file__).parent
N, STEP, PAIRS = 3, 2e-3, 8000
LOSSES = {"increment": IncrementLoss, "midpoint": MidpointLoss}


def make_windows() -> Windows:
    generator = torch.Generator().manual_seed(1)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return Windows(
        t=torch.tensor([0.0, STEP]),
        q=0.5 * draw(PAIRS, N),
        v=draw(PAIRS, N),
        p=0.05 * draw(PAIRS, N),
        dq=STEP * draw(PAIRS, 1, N),
        dv=5 * STEP * draw(PAIRS, 1, N),
        dp=0.2 * STEP * draw(PAIRS, 1, N),
        input=Signal(torch.tensor([0.0, STEP]), 0.5 * draw(PAIRS, 2, N)),
        past_q=torch.zeros(PAIRS, 0, N),
    )


def make_optimizer(name: str, vector: ParameterVector, members: int) -> Optimizer:
    """As conf/optimizer; the peak rate is small, as there is nothing to learn."""
    if name == "adamw":
        return AdamW([vector.values], lr=1e-4, weight_decay=1e-5, fused=True)
    kind = SOAP if members == 1 else MemberSOAP
    return kind(vector.parameters, lr=1e-4, weight_decay=1e-5)


def make_step(
    kind: str, members: int, batch: int, compiled: bool, loss: str, optim: str, length: int = 0
) -> Callable[[], None]:
    """One step of a training of that length, of a single model or of an ensemble."""
    models: list[Predictor] = [make_model(kind).float().train() for _ in range(members)]
    windows = make_windows()
    criterion = LOSSES[loss](windows.statistics(), models[0])
    samplers = [
        BatchSampler(PAIRS, batch_size=batch, batches=100_000, seed=k) for k in range(members)
    ]
    engine: Engine
    if members == 1:
        model, loader = models[0], WindowLoader(windows, samplers[0])
        vector = ParameterVector(model.parameters())
        engine = Compiled(criterion, model, vector, length)
    else:
        model = Ensemble(models).stack.train()
        loader = WindowLoader(windows, MemberSampler(samplers))
        vector = ParameterVector(model.parameters(), members)
        engine = CompiledMembers(criterion, model, vector)
    if not compiled:
        engine = Eager(criterion, model, vector)
    optimizer = make_optimizer(optim, vector, members)
    scheduler = OneCycleLR(optimizer, max_lr=1e-4, total_steps=100_000, cycle_momentum=False)
    batches = iter(loader)

    def step() -> None:
        _, gradient = engine(next(batches))
        vector.gradient.copy_(clipped(gradient, 1.0))
        optimizer.step()
        scheduler.step()

    return step


def seconds(step: Callable[[], None], clock: Callable[[], float]) -> float:
    start = clock()
    step()
    return clock() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=2, help="torch threads (default 2)")
    parser.add_argument("--models", nargs="+", default=["lnn", "hnn"])
    parser.add_argument("--loss", choices=LOSSES, default="increment")
    parser.add_argument("--optimizer", choices=["adamw", "soap"], default="adamw")
    parser.add_argument("--members", type=int, default=10)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--pairs", type=int, default=50, help="measured pairs of steps")
    parser.add_argument("--cpu-time", action="store_true", help="processor time, on a busy machine")
    parser.add_argument("--quick", action="store_true", help="smoke run: few, eager, no file")
    parser.add_argument("--output", type=Path, default=HERE / "results" / "ensemble.csv")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    clock = time.process_time if arguments.cpu_time else time.perf_counter
    rows = []
    for kind in arguments.models:
        compiled = not arguments.quick
        make = partial(
            make_step,
            kind,
            batch=arguments.batch,
            compiled=compiled,
            loss=arguments.loss,
            optim=arguments.optimizer,
        )
        steps = [make(1), make(1, length=STEPS_FOR_PROGRAM), make(arguments.members)]
        first = [seconds(step, time.perf_counter) for step in steps]
        for step in steps:
            step()
        times = [
            [seconds(step, clock) for step in steps]
            for _ in range(5 if arguments.quick else arguments.pairs)
        ]
        short, long, many = (statistics.median(column) for column in zip(*times, strict=True))
        rows.append(
            {
                "model": kind,
                "loss": arguments.loss,
                "optimizer": arguments.optimizer,
                "batch": arguments.batch,
                "members": arguments.members,
                "one_short_ms": round(1e3 * short, 2),
                "one_long_ms": round(1e3 * long, 2),
                "ensemble_ms": round(1e3 * many, 2),
                "ratio_short": round(statistics.median(many / one for one, _, many in times), 2),
                "ratio_long": round(statistics.median(many / one for _, one, many in times), 2),
                "first_step_short_s": round(first[0], 1),
                "first_step_long_s": round(first[1], 1),
                "first_step_ensemble_s": round(first[2], 1),
                "clock": "processor" if arguments.cpu_time else "wall",
                "threads": arguments.threads,
                **provenance(),
            }
        )
        print(rows[-1], flush=True)
    if not arguments.quick:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        with arguments.output.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        print(f"wrote {arguments.output}")


if __name__ == "__main__":
    main()
