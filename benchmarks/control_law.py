"""Time a control law for 7 joints at batch 1 in each file format, eager, and rigid-body code.

    python benchmarks/control_law.py
    python benchmarks/control_law.py --run runs/panda/lnn-seed0/<date>

The law is the paper's tracking law on a Lagrangian network of the size of experiment=panda.
The network is untrained, since the weights do not change the time; `--run` takes a trained network.
C code is timed in C, the others in Python. The rival is the inverse dynamics of the same arm in
Pinocchio, if installed. All take turns in one thread over the same random states. The script also
compares the outputs of each file with the eager law. On a busy machine the scheduler determines
the 99th percentile; `--real-time` uses the priority of a control loop.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from configured import build_model
from hydra import compose, initialize_config_dir

from pinn_dyn.app.config import CONF, resolved
from pinn_dyn.control import Pipeline, Tracking, export_law
from pinn_dyn.control.export import INPUTS
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.predictor import double_copy
from pinn_dyn.models import Statistics
from pinn_dyn.run.provenance import provenance
from pinn_dyn.run.run_folder import load_run
from pinn_dyn.systems.urdf import read_urdf

RESULTS = Path(__file__).parent / "results"
PANDA = "franka_panda/panda.urdf"
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
JOINTS = 7
STATES = 500
WARM_UP = 200  # calls
POSITION_GAIN = (600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0)  # paper, Nm/rad
VELOCITY_GAIN = (30.0, 30.0, 30.0, 30.0, 10.0, 10.0, 5.0)  # paper, Nms/rad

Call = tuple[Callable[..., Any], list[Any]]


def untrained() -> MechanicalSystem:
    """Return an untrained network of the size of the Panda experiment, with unit scales."""
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        config = resolved(compose("train", overrides=["experiment=panda", "model_name=lnn"]))
    one, increment = torch.ones(JOINTS), torch.ones(1, 2 * JOINTS)
    torch.manual_seed(0)
    statistics = Statistics(
        0 * one, one, -one, one, one, one, 0 * one, one, increment, increment, 1.0
    )
    model = build_model(config, statistics)
    assert isinstance(model, MechanicalSystem)
    return model


def pinocchio_rival(states: torch.Tensor) -> dict[str, Call]:
    """Return the inverse dynamics of the true arm at (q_ref, v_ref, a_ref)."""
    try:
        import pinocchio
    except ImportError:
        print("Pinocchio is not installed (pip install pin)")
        return {}
    full = pinocchio.buildModelFromUrdf(str(read_urdf(PANDA, locked_joints=FINGERS).path))
    locked = [full.getJointId(name) for name in FINGERS]
    model = pinocchio.buildReducedModel(full, locked, pinocchio.neutral(full))
    data = model.createData()

    def rnea(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> Any:
        return pinocchio.rnea(model, data, q, v, a)

    return {"Pinocchio inverse dynamics": (rnea, list(states[:, 2:].numpy()))}


TIMER = """
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include "law.h"
enum {{ N = law_NUM_COORDINATES, STATES = {states}, CALLS = {calls} }};
static double x[STATES][5][N], us[CALLS], u[law_NUM_INPUTS], memory[law_MEMORY_SIZE];
static double now(void) {{
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return 1e6 * t.tv_sec + 1e-3 * t.tv_nsec;
}}
static int order(const void *a, const void *b) {{
  const double d = *(const double *)a - *(const double *)b;
  return (d > 0) - (d < 0);
}}
int main(void) {{
  if (fread(x, sizeof x, 1, stdin) != 1) return 1;
  for (int k = -{warm_up}; k < CALLS; k++) {{
    double(*s)[N] = x[(k + {warm_up}) % STATES];
    const double start = now();
    law_control(s[0], s[1], s[2], s[3], s[4], memory, u, memory);
    if (k >= 0) us[k] = now() - start;
  }}
  qsort(us, CALLS, sizeof *us, order);
  printf("%.3f %.3f\\n", us[CALLS / 2], us[CALLS / 100 * 99]);
}}
"""


def timed_in_c(folder: Path, flags: list[str], states: torch.Tensor, calls: int) -> Any:
    """Compile law.c with a timer; return a function to its median and 99th percentile, us."""
    text = TIMER.format(states=STATES, calls=calls, warm_up=WARM_UP)
    (folder / "timer.c").write_text(text)
    program = folder / f"timer{flags[0]}"
    command = ["cc", "-std=c99", "-D_POSIX_C_SOURCE=200809L", *flags, "timer.c", "law.c", "-lm"]
    start = time.perf_counter()
    subprocess.run([*command, "-o", program.name], cwd=folder, check=True)
    print(f"cc {' '.join(flags)}: {time.perf_counter() - start:.1f} s")

    def measure() -> tuple[float, float]:
        data = states.numpy().tobytes()
        result = subprocess.run([str(program)], input=data, capture_output=True, check=True)
        median, late = result.stdout.split()
        return float(median), float(late)

    return measure


def percentiles(call: Call, calls: int) -> tuple[float, float]:
    """Return median and 99th percentile of the time of a call, us."""
    function, values = call
    seconds = np.empty(calls)
    for i in range(WARM_UP):
        function(*values[i % STATES])
    for i in range(calls):
        arguments = values[i % STATES]
        start = time.perf_counter()
        function(*arguments)
        seconds[i] = time.perf_counter() - start
    median, late = np.percentile(1e6 * seconds, [50, 99])
    return float(median), float(late)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--run", type=Path, help="run folder of a network with 7 joints")
    parser.add_argument("--calls", type=int, default=5000, help="timed calls of each")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument(
        "--real-time", action="store_true", help="time under SCHED_FIFO; needs the right to (root)"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model = load_run(arguments.run, "best").model if arguments.run else untrained()
    assert isinstance(model, MechanicalSystem)
    eager = Pipeline(Tracking(double_copy(model), POSITION_GAIN, VELOCITY_GAIN))

    generator = torch.Generator().manual_seed(1)
    shape = (STATES, len(INPUTS), JOINTS)
    states = 4 * torch.rand(shape, generator=generator, dtype=torch.float64) - 2
    tensors = [tuple(x.clone() for x in state) for state in states]
    memory = np.zeros(eager.memory_size)
    start_memory = torch.from_numpy(memory)
    arrays = [tuple(x.numpy() for x in state) for state in tensors]
    with tempfile.TemporaryDirectory() as name, torch.inference_mode(False):
        folder, paths = Path(name), {}
        for ending in ("c", "onnx", "casadi"):
            start = time.perf_counter()
            try:
                path = paths[ending] = export_law(eager, folder / f"law.{ending}")
            except ImportError as error:
                print(error)
                continue
            seconds, size = time.perf_counter() - start, path.stat().st_size / 1e6
            print(f"export to .{ending}: {seconds:.1f} s, {size:.2f} MB")
        calls: dict[str, Call] = {}
        if "onnx" in paths:
            import onnxruntime

            options = onnxruntime.SessionOptions()
            options.intra_op_num_threads = 1
            session = onnxruntime.InferenceSession(str(paths["onnx"]), options)
            names = [item.name for item in session.get_inputs()]

            def runtime(*x: np.ndarray) -> Any:
                return session.run(["u"], dict(zip(names, [*x, memory[None]], strict=True)))[0][0]

            batches = [tuple(x[None] for x in state) for state in arrays]
            calls["ONNX Runtime"] = (runtime, batches)
        if "casadi" in paths:
            import casadi

            function = casadi.Function.load(str(paths["casadi"]))
            calls["CasADi VM"] = (lambda *x: function(*x, memory)[0].full().ravel(), arrays)
        timers = {
            f"C, {' '.join(flags)}": timed_in_c(folder, flags, states, arguments.calls)
            for flags in (["-O3", "-march=native"], ["-O2"])
        }
        calls |= {"eager": (lambda *x: eager(*x, start_memory)[0], tensors)}
        with torch.inference_mode():
            expected = torch.stack([eager(*x, start_memory)[0] for x in tensors]).numpy()
            errors = {}
            for name, (call, values) in calls.items():
                difference = np.stack([np.asarray(call(*x)) for x in values]) - expected
                norms = np.linalg.norm(difference, axis=-1) / np.linalg.norm(expected, axis=-1)
                errors[name] = f"{norms.max():.1e}"
            calls |= pinocchio_rival(states)
            if arguments.real_time:
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
            times = [
                {name: measure() for name, measure in timers.items()}
                | {name: percentiles(call, arguments.calls) for name, call in calls.items()}
                for _ in range(arguments.repetitions)
            ]

    record = provenance()
    conditions = [
        "trained" if arguments.run else "untrained",
        "real-time" if arguments.real_time else "default",
        *(record[key] for key in ("hardware", "torch", "commit")),
    ]
    print(f"{record['hardware']}, torch {record['torch']}; {arguments.calls} calls each, us")
    RESULTS.mkdir(exist_ok=True)
    with (RESULTS / "control_law.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        header = ["method", "repetition", "median_us", "p99_us", "relative_error", "calls"]
        writer.writerow([*header, "model", "scheduler", "hardware", "torch", "commit"])
        for name in times[0]:
            median, late = min((x[name] for x in times), key=lambda x: x[1])
            every = ", ".join(f"{x[name][0]:.0f}/{x[name][1]:.0f}" for x in times)
            print(f"{name:34s} median {median:6.1f}   p99 {late:6.1f}   of {every}")
            for repetition, x in enumerate(times, 1):
                row = [name, repetition, f"{x[name][0]:.1f}", f"{x[name][1]:.1f}"]
                row.append(errors.get(name, ""))
                writer.writerow([*row, arguments.calls, *conditions])


if __name__ == "__main__":
    main()
