"""Time a control law for 7 joints at batch 1: compiled ahead of time, eager, and rigid-body code.

    python benchmarks/control_law.py
    python benchmarks/control_law.py --run runs/panda/lnn-seed0/<date>

The law is the paper's tracking law on a Lagrangian network of the size of experiment=panda.
The network is untrained, since the weights do not change the time; `--run` takes a trained network.
The rivals of the compiled law (pinn_dyn.control.export_law) are the eager law and the inverse
dynamics of the same arm in PyBullet and Pinocchio, if installed. All take turns in one thread over
the same random states. The script also compares the outputs of compiled and eager law. On a busy
machine the scheduler determines the 99th percentile; `--real-time` uses the priority of a control
loop.
"""

from __future__ import annotations

import argparse
import csv
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from configured import build_model
from hydra import compose, initialize_config_dir

from pinn_dyn.app.config import CONF, plain
from pinn_dyn.app.provenance import provenance
from pinn_dyn.app.run_folder import load_run
from pinn_dyn.control import Tracking, export_law, load_law
from pinn_dyn.control.export import INPUTS
from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.predictor import double_copy
from pinn_dyn.models import Statistics
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
        config = plain(compose("train", overrides=["experiment=panda", "model_name=lnn"]))
    one, increment = torch.ones(JOINTS), torch.ones(1, 2 * JOINTS)
    torch.manual_seed(0)
    statistics = Statistics(
        0 * one, one, -one, one, one, one, 0 * one, one, increment, increment, 1.0
    )
    model = build_model(config, statistics)
    assert isinstance(model, MechanicalSystem)
    return model


def rigid_body_rivals(states: torch.Tensor) -> dict[str, Call]:
    """Return the inverse dynamics of the true arm at (q_ref, v_ref, a_ref) by each library."""
    try:
        import pybullet
    except ImportError as error:
        print(error)
        return {}
    path = str(read_urdf(PANDA, locked_joints=FINGERS).path)
    pybullet.connect(pybullet.DIRECT)
    body = pybullet.loadURDF(path, useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE)
    pybullet.setGravity(0, 0, -9.81)
    fingers = [0.0] * len(FINGERS)

    def bullet(q: list[float], v: list[float], a: list[float]) -> Any:
        at = (q + fingers, v + fingers, a + fingers)
        return pybullet.calculateInverseDynamics(body, *at)[:JOINTS]

    desired = states[:, 2:].numpy()
    rivals: dict[str, Call] = {"PyBullet inverse dynamics": (bullet, desired.tolist())}
    try:
        import pinocchio
    except ImportError:
        print("Pinocchio is not installed (pip install pin)")
        return rivals
    full = pinocchio.buildModelFromUrdf(path)
    locked = [full.getJointId(name) for name in FINGERS]
    model = pinocchio.buildReducedModel(full, locked, pinocchio.neutral(full))
    data = model.createData()

    def rnea(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> Any:
        return pinocchio.rnea(model, data, q, v, a)

    q, v, a = desired[0]
    assert np.allclose(rnea(q, v, a), bullet(q.tolist(), v.tolist(), a.tolist()), rtol=1e-6)
    rivals["Pinocchio inverse dynamics"] = (rnea, list(desired))
    return rivals


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
    eager = Tracking(double_copy(model), POSITION_GAIN, VELOCITY_GAIN)

    generator = torch.Generator().manual_seed(1)
    shape = (STATES, len(INPUTS), JOINTS)
    states = 4 * torch.rand(shape, generator=generator, dtype=torch.float64) - 2
    tensors = [tuple(x.clone() for x in state) for state in states]
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        path = export_law(eager, Path(folder) / "law.pt2")
        print(f"export: {time.perf_counter() - start:.1f} s, {path.stat().st_size / 1e6:.1f} MB")
        compiled = load_law(path)
        bare = torch._inductor.aoti_load_package(str(path), run_single_threaded=True).loader

    with torch.inference_mode():
        expected = torch.stack([eager.law(*x) for x in tensors])
        error = torch.stack([compiled(*x) for x in tensors]) - expected
        worst = float((error.norm(dim=-1) / expected.norm(dim=-1)).max())
        print(f"compiled against eager, {STATES} states: at most {worst:.1e} apart (relative)")
        calls: dict[str, Call] = {
            "compiled, loaded by torch alone": (lambda *x: bare.run(list(x))[0], tensors),
            "compiled, loaded by load_law": (compiled, tensors),
            "eager": (eager.law, tensors),
            **rigid_body_rivals(states),
        }
        if arguments.real_time:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        times = [
            {name: percentiles(call, arguments.calls) for name, call in calls.items()}
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
        for name in calls:
            median, late = min((x[name] for x in times), key=lambda x: x[1])
            every = ", ".join(f"{x[name][0]:.0f}/{x[name][1]:.0f}" for x in times)
            print(f"{name:34s} median {median:6.1f}   p99 {late:6.1f}   of {every}")
            for repetition, x in enumerate(times, 1):
                apart = f"{worst:.1e}" if name.startswith("compiled") else ""
                row = [name, repetition, f"{x[name][0]:.1f}", f"{x[name][1]:.1f}", apart]
                writer.writerow([*row, arguments.calls, *conditions])


if __name__ == "__main__":
    main()
