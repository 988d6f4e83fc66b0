"""Long roll-outs of a learned model: compiled steps against the eager loop, side by side.

    python benchmarks/long_rollout.py                 # the table in benchmarks/README.md
    python benchmarks/long_rollout.py --quick         # a smoke run

float64, as evaluate.py; the one-segment soft arm's sizes (N = 3), steps of 0.0002 s for one
trajectory and 0.002 s for many. The networks have the sizes of conf/model and their initial
weights: what they have learned changes no time. The eager loop, torchdiffeq's fixed-step RK4, runs
for a part of the steps and is scaled up; its states are compared with those of the compiled one.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from pinn_dyn.app.provenance import provenance
from pinn_dyn.mechanics import RK4, MechanicalSystem, Signal
from pinn_dyn.mechanics.compilation import CompiledLoop, integrated_by
from pinn_dyn.models import (
    HamiltonianNetwork,
    LagrangianNetwork,
    NetworkCholesky,
    NetworkInput,
    NetworkPotential,
    Positive,
    Statistics,
)

HERE = Path(__file__).parent
N = 3


@dataclass(frozen=True)
class Case:
    """Trajectories of so many steps, and how many of the steps the eager loop is timed over."""

    trajectories: int
    steps: int
    step: float
    eager_steps: int


def make_model(kind: str) -> MechanicalSystem:
    """A network with the head sizes of conf/model and the scales of the one-segment arm."""
    torch.manual_seed(0)
    one = torch.ones(N, dtype=torch.float64)
    increment = torch.cat([2e-3 * one, 1e-2 * one])[None]
    scales = Statistics(
        q_mean=0 * one,
        q_std=0.5 * one,
        q_low=-2 * one,
        q_high=2 * one,
        v_std=one,
        p_std=0.05 * one,
        u_mean=0 * one,
        u_std=0.5 * one,
        qv_increment_std=increment,
        qp_increment_std=0.1 * increment,
        step=2e-3,
    )
    mass = partial(NetworkCholesky, hidden=[32, 32, 32])
    heads = {
        "potential": partial(NetworkPotential, hidden=[32, 32]),
        "damping": partial(NetworkCholesky, hidden=[16, 16], positivity=Positive(floor=0.0)),
        "input": partial(NetworkInput, hidden=[16, 16]),
    }
    network = {"lnn": LagrangianNetwork, "hnn": HamiltonianNetwork}[kind]
    return network(scales, mass, **heads).double().eval()


def timed(work: Callable[[], Tensor], clock: Callable[[], float]) -> tuple[float, Tensor]:
    start = clock()
    result = work()
    return clock() - start, result


def measure(kind: str, case: Case, clock: Callable[[], float]) -> dict[str, object]:
    """Seconds of both for one case.

    Raises:
        RuntimeError: if the states of both differ by more than 1e-9.
    """
    model = make_model(kind)
    generator = torch.Generator().manual_seed(1)
    batch = () if case.trajectories == 1 else (case.trajectories,)
    x0 = 0.1 * torch.randn(*batch, 2 * N, generator=generator, dtype=torch.float64)
    t = case.step * torch.arange(case.steps + 1, dtype=torch.float64)
    phase = torch.rand(*batch, 1, N, generator=generator, dtype=torch.float64)
    u = 0.3 * torch.sin(2 * t[:, None] + 6 * phase)

    def roll_out(steps: int, compiled: bool) -> Tensor:
        integrator = CompiledLoop(RK4()) if compiled else RK4()
        with torch.no_grad(), integrated_by(model, integrator):
            return model.predict(x0, t[: steps + 1], Signal(t[: steps + 1], u[..., : steps + 1, :]))

    compile_s, _ = timed(lambda: roll_out(2, compiled=True), time.perf_counter)
    warm_s, _ = timed(lambda: roll_out(2, compiled=True), clock)
    total_s, states = timed(lambda: roll_out(case.steps, compiled=True), clock)
    eager_s, expected = timed(lambda: roll_out(case.eager_steps, compiled=False), clock)
    difference = float((states[..., : case.eager_steps + 1, :] - expected).abs().max())
    if not difference <= 1e-9:
        raise RuntimeError(f"{kind}: the states of both differ by {difference:.2g}")
    return {
        "model": kind,
        "trajectories": case.trajectories,
        "steps": case.steps,
        "compiled_s": round(total_s - warm_s, 2),
        "with_warm_compile_s": round(total_s, 2),
        "first_compile_s": round(compile_s, 1),
        "eager_s": round(eager_s * case.steps / case.eager_steps, 1),
        "eager_timed_steps": case.eager_steps,
        "largest_difference": f"{difference:.1e}",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, default=2, help="torch threads (default 2)")
    parser.add_argument("--models", nargs="+", default=["lnn", "hnn"])
    parser.add_argument("--cpu-time", action="store_true", help="processor time, on a busy machine")
    parser.add_argument("--quick", action="store_true", help="smoke run: few steps, no file")
    parser.add_argument("--output", type=Path, default=HERE / "results" / "long_rollout.csv")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    cases = [Case(1, 50_000, 2e-4, 500), Case(1000, 5_000, 2e-3, 50)]
    if arguments.quick:
        cases = [Case(1, 200, 2e-4, 50)]
    clock = time.process_time if arguments.cpu_time else time.perf_counter
    environment = {
        "clock": "processor" if arguments.cpu_time else "wall",
        "threads": arguments.threads,
        **provenance(),
    }
    rows = []
    for kind in arguments.models:
        for case in cases:
            rows.append({**measure(kind, case, clock), **environment})
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
