"""A sweep of 12 short trainings, one after another and side by side.

Both are whole programs, from the command to its end: imports and the start of the workers count.

    python benchmarks/sweep.py            # the table in benchmarks/README.md, on a quiet machine
    python benchmarks/sweep.py --quick    # a smoke run
"""

from __future__ import annotations

import argparse
import csv
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pinn_dyn.run.provenance import provenance

HERE = Path(__file__).parent
TRAIN = HERE.parent / "train.py"
JOBS = ["model=hnn,lnn,mlp", "optimizer.lr=0.002,0.005", "seed=0,1"]
DATA = [
    "dataset.duration=2.0",
    "dataset.step=0.001",
    "dataset.train_initial_states=3",
    "dataset.train_inputs=3",
    "dataset.validation=2",
    "dataset.test=1",
    "data.stride=10",
    "data.pairs=4000",
]
SETTINGS = [
    "trainer.validations=1",
    "trainer.enable_progress_bar=false",
    "validator.horizon=0.5",
    "callbacks.figures=null",
]


def busy_seconds() -> list[float]:
    """Seconds that each core has worked since the machine started."""
    tick = os.sysconf("SC_CLK_TCK")
    rows = [line.split() for line in Path("/proc/stat").read_text().splitlines()]
    cores = [row for row in rows if row[0].startswith("cpu") and row[0] != "cpu"]
    # user, nice, system, idle, iowait, irq, softirq, steal
    return [sum(int(row[k]) for k in (1, 2, 3, 6, 7)) / tick for row in cores]


def timed(folder: Path, *words: str) -> dict[str, float]:
    """Run a sweep; its wall time, its own CPU time and what each core did meanwhile."""
    start, cores = time.perf_counter(), busy_seconds()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, str(TRAIN), "-m", *words, f"hydra.sweep.dir={folder}"],
        check=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    seconds = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    shares = [(b - a) / seconds for a, b in zip(cores, busy_seconds(), strict=True)]
    return {
        "seconds": seconds,
        "cpu_seconds": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "jobs": len(list(folder.glob("*/metrics.json"))),
        "idlest_core": min(shares),
        "busiest_core": max(shares),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a smoke run of shorter trainings")
    parser.add_argument("--processes", type=int, default=2, help="trainings side by side")
    arguments = parser.parse_args()
    words = [*JOBS, *DATA, *SETTINGS, f"trainer.steps={40 if arguments.quick else 1400}"]
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # The data are simulated before anything is timed.
        timed(folder / "warm", *DATA, *SETTINGS, "model=mlp", "trainer.steps=1")
        for launcher, choice in (
            ("one after another", []),
            (
                "side by side",
                ["hydra/launcher=joblib", f"hydra.launcher.n_jobs={arguments.processes}"],
            ),
        ):
            rows.append({"launcher": launcher, **timed(folder / str(len(rows)), *words, *choice)})
    for row in rows:
        row["ratio"] = rows[0]["seconds"] / row["seconds"]
        row["busy"] = row["cpu_seconds"] / row["seconds"] / arguments.processes
        print(
            f"{row['launcher']:18s} {row['jobs']} jobs in {row['seconds']:6.1f} s, "
            f"{row['ratio']:.2f} x; the sweep itself keeps {arguments.processes} cores "
            f"{100 * row['busy']:.0f} % busy; with everything else on the machine, the idlest core "
            f"{100 * row['idlest_core']:.0f} %, the busiest {100 * row['busiest_core']:.0f} %"
        )
    if not arguments.quick:
        path = HERE / "results" / "sweep.csv"
        with path.open("w", newline="") as file:
            known = provenance()
            writer = csv.DictWriter(file, [*rows[0], "hardware", "torch", "commit"])
            writer.writeheader()
            for row in rows:
                figures = {k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()}
                writer.writerow(
                    {**figures, **{k: known[k] for k in ("hardware", "torch", "commit")}}
                )


if __name__ == "__main__":
    main()
