"""Time of one Lagrangian training step, against per-sample Hessians of the Lagrangian.

A step is: gradients set to None, one RK4 step of the whole batch, the increment loss, its backward
pass. No optimizer. Both sides share weights, batch, integrator and loss, and are first checked to
give the same loss and the same gradients in float64.

    python benchmarks/training_step.py                # the table in benchmarks/README.md
    python benchmarks/training_step.py --quick        # a smoke run, some seconds
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from datetime import datetime, timezone
from functools import partial
from pathlib import Path

import torch
from hessian_baseline import HessianBaseline
from torch import Tensor

from pinn_dyn.models import (
    LagrangianNetwork,
    NetworkCholesky,
    NetworkInput,
    NetworkPotential,
    Statistics,
)
from pinn_dyn.training import IncrementLoss

STEP = 2e-3
HERE = Path(__file__).parent
FIELDS = [
    "coordinates",
    "batch",
    "ours",
    "baseline_chunk",
    "pairs",
    "ours_ms",
    "baseline_ms",
    "ratio_median",
    "ratio_min",
    "ratio_max",
    "compile_s",
]


def make_model(size: int, dtype: torch.dtype) -> tuple[LagrangianNetwork, Statistics]:
    """The network with the head sizes of conf/model, off its nearly diagonal start."""
    torch.manual_seed(0)
    one = torch.ones(size, dtype=torch.float64)
    increment = torch.cat([STEP * one, STEP * one])[None]
    scales = Statistics(0 * one, one, one, one, 0 * one, one, increment, increment, STEP)
    model = LagrangianNetwork(
        scales,
        mass=partial(NetworkCholesky, hidden=[32, 32, 32], epsilon=1e-3),
        potential=partial(NetworkPotential, hidden=[32, 32]),
        damping=partial(NetworkCholesky, hidden=[16, 16], epsilon=0.0),
        input=partial(NetworkInput, hidden=[16, 16]),
    )
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    return model.to(dtype).train(), scales


def make_batch(size: int, batch: int, dtype: torch.dtype) -> dict[str, Tensor]:
    """Windows of one step: states, inputs at both ends, measured increments."""
    generator = torch.Generator().manual_seed(1)
    x0 = torch.randn(batch, 2 * size, generator=generator, dtype=torch.float64)
    u = torch.randn(batch, 2, size, generator=generator, dtype=torch.float64)
    measured = STEP * torch.randn(batch, 1, 2 * size, generator=generator, dtype=torch.float64)
    t = torch.tensor([0.0, STEP], dtype=torch.float64)
    return {"x0": x0.to(dtype), "u": u.to(dtype), "measured": measured.to(dtype), "t": t}


def make_step(
    increments: Callable[..., Tensor],
    model: LagrangianNetwork,
    loss: IncrementLoss,
    batch: dict[str, Tensor],
    chunk: int | None = None,
) -> Callable[[], float]:
    """One training step; in chunks of samples, gradients added up, if ``chunk`` is given."""
    count = batch["x0"].shape[0]
    chunk = chunk or count

    def step() -> float:
        model.zero_grad(set_to_none=True)
        total = 0.0
        for k in range(0, count, chunk):
            part = slice(k, k + chunk)
            predicted = increments(batch["x0"][part], batch["t"], batch["u"][part])
            value = loss.error(predicted[:, 1:], batch["measured"][part])
            value = value * (predicted.shape[0] / count)
            value.backward()
            total += float(value.detach())
        return total

    return step


def gradients(model: LagrangianNetwork) -> dict[str, Tensor]:
    return {
        name: torch.zeros_like(p) if p.grad is None else p.grad.clone()
        for name, p in model.named_parameters()
    }


def check_equal(size: int, dtype: torch.dtype, tolerance: float, compiled: bool) -> float:
    """Largest relative difference of loss and gradients between the two sides.

    Raises:
        RuntimeError: if it exceeds the tolerance.
    """
    model, scales = make_model(size, dtype)
    loss = IncrementLoss(scales, model).to(dtype)
    batch = make_batch(size, 256 if compiled else 64, dtype)
    if compiled:
        model.compile_derivative()
    sides = []
    for increments in (model.increments, HessianBaseline(model).increments):
        value = make_step(increments, model, loss, batch)()
        sides.append((value, gradients(model)))
    (ours, our_gradients), (theirs, their_gradients) = sides
    largest = max(float(g.abs().max()) for g in their_gradients.values())
    worst = abs(ours - theirs) / abs(theirs)
    for name, expected in their_gradients.items():
        difference = float((our_gradients[name] - expected).abs().max())
        worst = max(worst, difference / max(float(expected.abs().max()), 1e-3 * largest))
    if not worst <= tolerance:
        raise RuntimeError(f"N = {size}: loss or gradients differ by {worst:.2g} (relative)")
    return worst


def measure(
    ours: Callable[[], float], baseline: Callable[[], float], pairs: int
) -> tuple[list[float], list[float]]:
    """Seconds of both, turn by turn (A B A B ...), after one step of each to warm up."""
    times: tuple[list[float], list[float]] = ([], [])
    ours(), baseline()
    for _ in range(pairs):
        for step, record in zip((ours, baseline), times, strict=True):
            start = time.perf_counter()
            step()
            record.append(time.perf_counter() - start)
    return times


def timed(step: Callable[[], float]) -> float:
    start = time.perf_counter()
    step()
    return time.perf_counter() - start


def best_chunk(make: Callable[[int | None], Callable[[], float]], batch: int) -> int | None:
    """The fastest of the whole batch and smaller parts of it, in favour of the baseline."""
    if batch <= 1000:
        return None
    candidates: list[int | None] = [None, 2000, 500]
    make(500)()
    return min(candidates, key=lambda chunk: timed(make(chunk)))


def run_cell(size: int, batch_size: int, pairs: int, compile_ours: bool) -> list[dict[str, object]]:
    """Rows of one cell: our model eager and compiled, each beside the baseline."""
    dtype = torch.float32
    batch = make_batch(size, batch_size, dtype)
    model, scales = make_model(size, dtype)
    loss = IncrementLoss(scales, model).to(dtype)
    rival = HessianBaseline(model)

    def rival_step(chunk: int | None) -> Callable[[], float]:
        return make_step(rival.increments, model, loss, batch, chunk)

    chunk = best_chunk(rival_step, batch_size)
    rows: list[dict[str, object]] = []
    for name in ["eager", "compiled"] if compile_ours else ["eager"]:
        if name == "compiled":
            model.compile_derivative()
        ours = make_step(model.increments, model, loss, batch)
        first, second = timed(ours), timed(ours)
        a, b = measure(ours, rival_step(chunk), pairs)
        ratios = [theirs / own for own, theirs in zip(a, b, strict=True)]
        rows.append(
            {
                "coordinates": size,
                "batch": batch_size,
                "ours": name,
                "baseline_chunk": chunk or batch_size,
                "pairs": pairs,
                "ours_ms": round(1e3 * statistics.median(a), 2),
                "baseline_ms": round(1e3 * statistics.median(b), 2),
                "ratio_median": round(statistics.median(ratios), 2),
                "ratio_min": round(min(ratios), 2),
                "ratio_max": round(max(ratios), 2),
                "compile_s": round(first - second, 1) if name == "compiled" else 0.0,
            }
        )
        print(table_row(rows[-1]), flush=True)
    return rows


def table_row(row: dict[str, object]) -> str:
    return (
        f"| {row['coordinates']} | {row['batch']} | {row['ours']} | {row['ours_ms']} "
        f"| {row['baseline_ms']} ({row['baseline_chunk']}) | **{row['ratio_median']}** "
        f"| {row['ratio_min']} to {row['ratio_max']} | {row['compile_s'] or '-'} |"
    )


def hardware() -> str:
    """Model name of the processor and the number of cores, as the system tells them."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores"


def commit() -> str:
    """Short hash of the checkout, with a plus if pinn_dyn differs from it."""

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", *arguments], cwd=HERE, capture_output=True, text=True, check=False
        )
        return done.stdout.strip()

    return git("rev-parse", "--short", "HEAD") + ("+" if git("status", "-s", "../pinn_dyn") else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=1, help="torch threads (default 1)")
    parser.add_argument("--pairs", type=int, default=0, help="measured pairs per row")
    parser.add_argument("--no-compile", action="store_true", help="leave out compiled variants")
    parser.add_argument("--quick", action="store_true", help="smoke run: small, eager, no file")
    parser.add_argument("--output", type=Path, default=HERE / "results" / "training_step.csv")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    compile_ours = not (arguments.no_compile or arguments.quick)
    sizes = [3] if arguments.quick else [3, 7]
    for size in sizes:
        worst = check_equal(size, torch.float64, 1e-8, compiled=False)
        print(f"N = {size}: same loss and gradients in float64 up to {worst:.1e} (relative)")
    environment: dict[str, object] = {
        "hardware": hardware(),
        "threads": arguments.threads,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "commit": commit(),
        "date": datetime.now(timezone.utc).isoformat(timespec="minutes"),
    }
    print("; ".join(f"{key} {value}" for key, value in environment.items()))
    print(
        "| N | batch | ours | ours, ms | Hessian, ms (chunk) | ratio | smallest to largest "
        "| compile, s |\n|---|---|---|---|---|---|---|---|"
    )
    rows = []
    for size in sizes:
        for batch_size, pairs in [(32, 2)] if arguments.quick else [(256, 15), (8000, 5)]:
            rows += run_cell(size, batch_size, arguments.pairs or pairs, compile_ours)
    if compile_ours:
        for size in sizes:
            worst = check_equal(size, torch.float32, 1e-3, compiled=True)
            print(f"N = {size}: compiled, float32, same up to {worst:.1e} (relative)")
    if not arguments.quick:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        with arguments.output.open("w", newline="") as file:
            writer = csv.DictWriter(file, [*FIELDS, *environment])
            writer.writeheader()
            writer.writerows({**row, **environment} for row in rows)
        print(f"wrote {arguments.output}")


if __name__ == "__main__":
    main()
