"""Time the simulation of a data set against a naive fixed-step loop.

    python benchmarks/data_generation.py
    python benchmarks/data_generation.py --dataset soft_arm_2

The data set is that of conf/dataset, soft_arm_1 by default, simulated in full, without the cache
and with the time to compile where it compiles. The naive loop is what a first script would do: each
trajectory on its own, classic RK4 at the data's own step. It is timed on a piece of one trajectory,
next to the full simulation in the same run, and scaled to the whole set; the piece's length is
printed. A second loop does the same with all trajectories in one batch. The accuracy of the data is
checked by rolling the truth itself out along the test trajectories, as a learned model would be.
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_dir

from pinn_dyn.app.config import CONF, resolved
from pinn_dyn.data import SimulatedSource
from pinn_dyn.evaluation import predict_trajectories
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.run.configuration.build import build_source
from pinn_dyn.run.provenance import provenance

RESULTS = Path(__file__).parent / "results"
ROLLOUT_STEP = 0.002  # s


def naive_rk4(source: SimulatedSource, q: torch.Tensor, v: torch.Tensor, steps: int) -> float:
    """Seconds of a classic RK4 loop over ``steps`` samples, for states ``(K, N)``."""
    h = source.step
    x = torch.cat([q, v], dim=-1)
    u = torch.zeros_like(q)
    f = source.system.velocity_derivative
    start = time.perf_counter()
    with torch.inference_mode():
        for _ in range(steps):
            k1 = f(x, u)
            k2 = f(x + h / 2 * k1, u)
            k3 = f(x + h / 2 * k2, u)
            k4 = f(x + h * k3, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return time.perf_counter() - start


def _batches(shapes: list[tuple[int, int]]) -> dict[int, int]:
    """Number of trajectories by their number of steps."""
    batches: dict[int, int] = {}
    for count, samples in shapes:
        batches[samples - 1] = batches.get(samples - 1, 0) + count
    return batches


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=int, default=400, help="samples in the timed piece")
    parser.add_argument("--dataset", default="soft_arm_1", help="name in conf/dataset")
    arguments = parser.parse_args()
    steps = arguments.steps
    torch.set_num_threads(1)
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        overrides = [f"dataset={arguments.dataset}", "model_name=none"]
        config = resolved(compose("train", overrides=overrides))
    source = build_source(config)
    assert isinstance(source, SimulatedSource)

    start = time.perf_counter()
    arrays = source.simulate()
    adaptive = time.perf_counter() - start
    # Trajectories and their samples: a naive script would not simulate more than it keeps either.
    shapes = [arrays[f"{split}_q"].shape[:2] for split in ("train", "validation", "test")]
    count = sum(shape[0] for shape in shapes)
    samples = max(shape[1] for shape in shapes) - 1
    all_samples = sum(shape[0] * (shape[1] - 1) for shape in shapes)

    t, *test = (torch.from_numpy(arrays[key]) for key in ("t", "test_q", "test_v", "test_u"))
    q, v, u = test
    truth = Trajectory(q, v, Signal(t[: q.shape[1]], u)).until(5.0)
    own = predict_trajectories(source.system, truth, step=ROLLOUT_STEP)
    error = float(own.error().mean())

    rng = np.random.default_rng(0)
    q, v = (torch.from_numpy(x) for x in source.initial_states.draw(count, rng))
    single = naive_rk4(source, q[:1], v[:1], steps) * all_samples / steps
    # One batch after the other for splits of different length.
    batched = sum(
        naive_rk4(source, q[:size], v[:size], steps) * length / steps
        for length, size in _batches(shapes).items()
    )

    rows = [
        ("adaptive, batched, dense output (this package)", adaptive),
        ("fixed step, batched (scaled from a piece)", batched),
        ("fixed step, one trajectory at a time (scaled from a piece)", single),
    ]
    print(
        f"{count} trajectories at {source.step:g} s, training {source.duration:g} s, the others "
        f"{source.test_duration:g} s"
    )
    print(f"fixed-step loops timed over {steps} of {samples} samples; {provenance()['hardware']}")
    print(f"the truth, rolled out for 5 s by RK4 at {ROLLOUT_STEP:g} s, misses by {error:.1e}")
    RESULTS.mkdir(exist_ok=True)
    with (RESULTS / f"data_generation_{arguments.dataset}.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["method", "seconds", "ratio", "hardware", "commit"])
        for name, seconds in rows:
            print(f"{name:60s} {seconds:10.1f} s   {seconds / adaptive:8.1f} x")
            writer.writerow(
                [
                    name,
                    f"{seconds:.1f}",
                    f"{seconds / adaptive:.2f}",
                    provenance()["hardware"],
                    provenance()["commit"],
                ]
            )


if __name__ == "__main__":
    main()
