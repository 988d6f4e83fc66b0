"""Time of one Lagrangian training step, beside JAX and beside Hessians of the Lagrangian.

A step is: one RK4 step of the batch, the increment loss, its gradient; no optimizer. All sides
share weights, data, integrator (3/8 rule) and loss, and are first checked in float64 to give the
same loss and the same gradient; the midpoint loss alone is another, for the same job.

    ours, compiled    loss and gradient as one program, as a long training with compile=true
    ours, derivative  the compiled state derivative alone, as a shorter one
    ours, eager       compile=false
    ours, midpoint    another loss, loss=midpoint, compiled: one evaluation of the dynamics
    jax autodiff      the structured formulas in JAX, two spellings, jitted with their gradient
    jax explicit
    jax hessian       the paper's way in JAX: Hessian of L and an explicit inverse, jitted
    torch hessian     the same in torch.func with a linear solve, eager

    python benchmarks/training_step.py                    # 1 core, then 2; the tables of README.md
    python benchmarks/training_step.py --quick            # a smoke run, no file

Each number of cores is a process of its own that may run on so many cores only. Ours takes as
many threads, as train.py with threads=2; JAX takes what it finds.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hessian_baseline import HessianBaseline
from torch import Tensor

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import Signal
from pinn_dyn.mechanics.compilation import STEPS_FOR_PROGRAM
from pinn_dyn.models import (
    LagrangianNetwork,
    NetworkCholesky,
    NetworkInput,
    NetworkPotential,
    Positive,
    Statistics,
)
from pinn_dyn.run.provenance import provenance
from pinn_dyn.training import IncrementLoss, MidpointLoss, ParameterVector
from pinn_dyn.training.gradients import Compiled, Engine

STEP = 2e-3
RESULTS = Path(__file__).parent / "results"
OURS = "ours, compiled"
MIDPOINT = "ours, midpoint"
Step = Callable[[], Any]


def make_model(size: int, dtype: torch.dtype) -> tuple[LagrangianNetwork, Statistics]:
    """The network with the head sizes of conf/model, off its nearly diagonal start."""
    torch.manual_seed(0)
    one = torch.ones(size, dtype=torch.float64)
    increment = torch.cat([STEP * one, STEP * one])[None]
    scales = Statistics(
        0 * one, one, -5 * one, 5 * one, one, one, 0 * one, one, increment, increment, STEP
    )
    model = LagrangianNetwork(
        scales,
        mass=partial(NetworkCholesky, hidden=[32, 32, 32]),
        potential=partial(NetworkPotential, hidden=[32, 32]),
        damping=partial(NetworkCholesky, hidden=[16, 16], positivity=Positive(floor=0.0)),
        input=partial(NetworkInput, hidden=[16, 16]),
    )
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.05 * torch.randn_like(parameter)
    return model.to(dtype).train(), scales


def make_windows(size: int, batch: int, dtype: torch.dtype) -> Windows:
    """Windows of one step, at random."""
    generator = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    t = torch.tensor([0.0, STEP], dtype=torch.float64)
    empty = torch.zeros(batch, 0, dtype=torch.float64)
    windows = Windows(
        t=t,
        q=normal(batch, size),
        v=normal(batch, size),
        p=empty,
        dq=STEP * normal(batch, 1, size),
        dv=STEP * normal(batch, 1, size),
        dp=empty[:, None],
        input=Signal(t, normal(batch, 2, size)),
        past_q=torch.zeros(batch, 0, size, dtype=torch.float64),
    )
    return windows.to(torch.device("cpu"), dtype)


def torch_step(model: LagrangianNetwork, loss: Callable[[], Tensor]) -> Step:
    """Gradients set to None, loss, backward pass."""

    def step() -> float:
        model.zero_grad(set_to_none=True)
        value = loss()
        value.backward()
        return float(value.detach())

    return step


def our_step(engine: Engine, windows: Windows) -> Step:
    """Loss and gradient of an engine."""
    return lambda: float(engine(windows)[0])


def hessian_step(
    model: LagrangianNetwork, loss: IncrementLoss, windows: Windows, chunk: int
) -> Step:
    """The step of the torch.func baseline, gradients added up over chunks of the batch."""
    baseline, count = HessianBaseline(model), len(windows)

    def step() -> float:
        model.zero_grad(set_to_none=True)
        total = 0.0
        for index in torch.arange(count).split(chunk):
            part = windows[index]
            path = baseline.increments(part.start("qv"), part.t, Signal(part.t, part.u))
            value = loss.error(path[:, 1:], part.increments("qv")) * (len(part) / count)
            value.backward()
            total += float(value.detach())
        return total

    return step


def jax_steps(
    model: LagrangianNetwork, loss: IncrementLoss, windows: Windows, names: list[str]
) -> dict[str, Step]:
    """Jitted loss and gradient of the named accelerations, each ending when the result is there."""
    import jax
    import jax_networks

    network, parameters = jax_networks.Network(model), jax_networks.parameters_of(model)
    batch = {
        "x0": windows.start("qv"),
        "u": windows.u,
        "measured": windows.increments("qv")[:, 0],
    }
    arrays = jax_networks.to_jax(batch)
    steps: dict[str, Step] = {}
    for name in names:
        step = jax_networks.training_step(getattr(network, name), STEP, loss.scale[0].numpy())

        def run(step: Any = step) -> Any:
            return jax.block_until_ready(step(parameters, arrays))

        steps[f"jax {name}"] = run
    return steps


def check_equal(size: int) -> float:
    """Largest relative difference of loss and gradients between all ways, in float64.

    Raises:
        RuntimeError: if it exceeds 1e-8.
    """
    import jax

    with jax.enable_x64(True):
        model, scales = make_model(size, torch.float64)
        loss = IncrementLoss(scales, model).double()
        windows = make_windows(size, 64, torch.float64)
        value = torch_step(model, lambda: loss(model, windows))()
        expected = gradients(model)
        largest = max(float(g.abs().max()) for g in expected.values())
        others = {"torch hessian": (hessian_step(model, loss, windows, 64)(), gradients(model))}
        for name, run in jax_steps(
            model, loss, windows, ["autodiff", "explicit", "hessian"]
        ).items():
            jax_value, tree = run()
            others[name] = (float(jax_value), named(tree))
    worst = 0.0
    for other, found in others.values():
        worst = max(worst, abs(other - value) / value)
        for name, gradient in found.items():
            scale = max(float(expected[name].abs().max()), 1e-3 * largest)
            worst = max(worst, float((gradient - expected[name]).abs().max()) / scale)
    if not worst <= 1e-8:
        raise RuntimeError(f"N = {size}: loss or gradients differ by {worst:.2g} (relative)")
    return worst


def gradients(model: LagrangianNetwork) -> dict[str, Tensor]:
    """Gradients by name; zero where there is none."""
    return {
        name: torch.zeros_like(p) if p.grad is None else p.grad.clone()
        for name, p in model.named_parameters()
    }


def named(tree: dict[str, Any]) -> dict[str, Tensor]:
    """A gradient of jax_networks under the names of the torch parameters."""
    found = {"potential.stiffness_root": torch.tensor(tree["root"].__array__())}
    for head in ("mass", "potential", "damping", "input"):
        for k, (weight, bias) in enumerate(tree[head]):
            found[f"{head}.network.layers.{k}.weight"] = torch.tensor(weight.__array__()).mT
            found[f"{head}.network.layers.{k}.bias"] = torch.tensor(bias.__array__())
    return found


def timed(step: Step) -> float:
    """Seconds of one step."""
    start = time.perf_counter()
    step()
    return time.perf_counter() - start


def in_a_row(step: Step, seconds: float = 0.03) -> float:
    """Seconds of a step among its like, as in a training: the mean after a first one."""
    step()
    start, count = time.perf_counter(), 0
    while count == 0 or time.perf_counter() - start < seconds:
        step()
        count += 1
    return (time.perf_counter() - start) / count


def peak_memory(step: Step) -> float:
    """Most memory that a step adds to the process, MiB (Linux); what is cached is freed first."""

    def status(key: str) -> float:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(float(line.split()[1]) for line in lines if line.startswith(key)) / 1024

    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")  # starts the high-water mark anew
    before = status("VmRSS")
    step()
    return status("VmHWM") - before


def run_cell(size: int, batch: int, cores: int, seconds: float) -> list[dict[str, object]]:
    """Rows of one cell; in every round each way takes its turn, for ``seconds`` or 5 rounds."""
    torch._dynamo.reset()  # one batch size after another would compile for varying sizes
    windows = make_windows(size, batch, torch.float32)
    model, scales = make_model(size, torch.float32)
    eager_model, short_model, mid_model = (make_model(size, torch.float32)[0] for _ in range(3))
    eager_loss, short_loss, loss = (IncrementLoss(scales, model) for _ in range(3))
    mid_loss = MidpointLoss(scales, mid_model)
    compiled = Compiled(loss, model, ParameterVector(model.parameters()), STEPS_FOR_PROGRAM)
    midpoint = Compiled(
        mid_loss, mid_model, ParameterVector(mid_model.parameters()), STEPS_FOR_PROGRAM
    )
    short = Compiled(short_loss, short_model, ParameterVector(short_model.parameters()), 0)
    names = ["autodiff", "explicit", "hessian"]
    steps = {
        OURS: our_step(compiled, windows),
        "ours, derivative": our_step(short, windows),
        "ours, eager": torch_step(eager_model, lambda: eager_loss(eager_model, windows)),
        MIDPOINT: our_step(midpoint, windows),
        **jax_steps(model, loss, windows, names),
        "torch hessian": hessian_step(eager_model, eager_loss, windows, 1024),
    }
    compiling = {name: timed(step) - timed(step) for name, step in steps.items()}
    memory = {name: peak_memory(step) for name, step in steps.items()}
    # The slowest way alone takes most of a round: it sits out all but the first three.
    times: dict[str, list[float]] = {name: [] for name in steps}
    start = time.perf_counter()
    rounds = 0
    while rounds < 5 or time.perf_counter() - start < seconds:
        for name, step in steps.items():
            if rounds < 3 or "hessian" not in name:
                times[name].append(in_a_row(step))
        rounds += 1
    rows: list[dict[str, object]] = []
    for name, values in times.items():
        ratios = [other / own for own, other in zip(times[OURS], values, strict=False)]
        rows.append(
            {
                "coordinates": size,
                "batch": batch,
                "cores": cores,
                "method": name,
                "rounds": len(values),
                "ms": round(1e3 * statistics.median(values), 3),
                "us_per_sample": round(1e6 * statistics.median(values) / batch, 2),
                "slower_than_ours": round(statistics.median(ratios), 3),
                "smallest": round(min(ratios), 3),
                "largest": round(max(ratios), 3),
                "first_step_s": 0.0 if "eager" in name else round(max(compiling[name], 0.0), 1),
                "memory_mib": round(memory[name], 1),
            }
        )
        print(table_row(rows[-1]), flush=True)
    return rows


def table_row(row: dict[str, object]) -> str:
    """A line of the README's table."""
    return (
        f"| {row['coordinates']} | {row['batch']} | {row['method']} | {row['ms']} "
        f"| {row['us_per_sample']} | **{row['slower_than_ours']}** | {row['smallest']} to "
        f"{row['largest']} | {row['first_step_s'] or '-'} | {row['memory_mib']} |"
    )


def summary(rows: list[dict[str, object]]) -> str:
    """Geometric means over the cells, against the faster of the two structured versions in JAX."""
    cells: dict[tuple[object, object], dict[object, float]] = {}
    for row in rows:
        cell = cells.setdefault((row["coordinates"], row["batch"]), {})
        cell[row["method"]] = float(str(row["slower_than_ours"]))
    lines = []
    for title, value in (
        ("structured JAX", lambda cell: min(cell["jax autodiff"], cell["jax explicit"])),
        ("Hessian in JAX", lambda cell: cell["jax hessian"]),
        ("Hessian in JAX, our midpoint loss", lambda cell: cell["jax hessian"] / cell[MIDPOINT]),
        ("Hessian in torch", lambda cell: cell["torch hessian"]),
    ):
        ratios = [value(cell) for cell in cells.values()]
        lines.append(
            f"{title}: time of a step over ours {statistics.geometric_mean(ratios):.2f} in the "
            f"geometric mean, {min(ratios):.2f} in the closest cell"
        )
    return "\n".join(lines)


def run(cores: int, sizes: list[int], batches: list[int], seconds: float, output: Path) -> None:
    """All cells in this process, on its first ``cores`` cores."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    torch.set_num_threads(cores)
    for size in sizes:
        print(f"N = {size}: same loss and gradients in float64 up to {check_equal(size):.1e}")
    print(f"cores: {cores}")
    print("| N | batch | way | ms | us a sample | x ours | smallest to largest | compile s | MiB |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    rows = [row for n in sizes for b in batches for row in run_cell(n, b, cores, seconds)]
    print(summary(rows), flush=True)
    import jax

    record = {key: provenance()[key] for key in ("hardware", "torch", "commit")}
    with output.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*rows[0], *record, "jax"])
        writer.writeheader()
        writer.writerows({**row, **record, "jax": jax.__version__} for row in rows)
    print(f"wrote {output}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cores", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--sizes", type=int, nargs="+", default=[3, 6, 7], help="N")
    parser.add_argument("--batches", type=int, nargs="+", default=[256, 1024, 8192])
    parser.add_argument("--seconds", type=float, default=3.0, help="timing of each cell")
    parser.add_argument("--quick", action="store_true", help="smoke run: one small cell, no file")
    arguments = parser.parse_args()
    if arguments.quick:
        run(1, [2], [32], 0.1, Path(os.devnull))
    elif len(arguments.cores) == 1:
        (cores,) = arguments.cores
        output = RESULTS / f"training_step_{cores}_core{'s' if cores > 1 else ''}.csv"
        run(cores, arguments.sizes, arguments.batches, arguments.seconds, output)
    else:
        for cores in arguments.cores:
            command = [sys.executable, *sys.argv, "--cores", str(cores)]
            subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
