"""The usual calls of an identified robot, beside MuJoCo on the same robot, in one run.

    python benchmarks/usual_calls.py
    python benchmarks/usual_calls.py --quick          # a smoke run

The robot is the Panda of the package with Coulomb friction (`known`, 7 joints), integrated by RK4
in float64. MuJoCo has the same bodies without friction, limits and contacts, and RK4. The calls
take turns for some rounds, and the table has the median of each. Environments hold an action for
one step of the integration.
"""

from __future__ import annotations

import argparse
import csv
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import mujoco
import mujoco.rollout
import numpy as np
import torch
from long_rollout import FINGERS, PANDA, STEP, models_of, mujoco_model
from torch import Tensor

from pinn_dyn.envs import ModelPlant, RobotEnv, RobotVectorEnv
from pinn_dyn.evaluation.prediction import model_for_rollouts
from pinn_dyn.exports import compiled
from pinn_dyn.exports.exported_function import write
from pinn_dyn.exports.model_functions import model_functions
from pinn_dyn.mechanics import Signal, Trajectory, double_copy
from pinn_dyn.models import KnownMechanics
from pinn_dyn.run.provenance import provenance
from pinn_dyn.systems import MujocoArm, RigidChain

HERE = Path(__file__).parent
MOTIONS, STEPS = 1024, 100
_CALLS_OF_LAW = 20_000
_MAIN = """
#include <stdio.h>
#include <time.h>
#include "arm.h"
int main(void) {{
  double q[{n}], v[{n}], a[{n}], tau[{n}], sum = 0;
  for (int i = 0; i < {n}; i++) q[i] = v[i] = a[i] = 0.1 * i;
  clock_t start = clock();
  for (int k = 0; k < {calls}; k++) {{
    q[0] += 1e-9;
    arm_inverse_dynamics(q, v, a, tau);
    sum += tau[0];
  }}
  printf("%.6g %g", (double)(clock() - start) / CLOCKS_PER_SEC, sum);
}}
"""


class Motions:
    """Random motions of n joints, the data of the environments."""

    name, angles = "motions", ()

    def __init__(self, n: int):
        rng, t = torch.Generator().manual_seed(0), STEP * torch.arange(400).double()
        q, v, u = 0.3 * torch.randn(3, 3, 400, n, generator=rng).double()
        items = [Trajectory(*pair, Signal(t, x)) for *pair, x in zip(q, v, u, strict=True)]
        self.splits = SimpleNamespace(train=items)

    def load(self) -> SimpleNamespace:
        return self.splits


def seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def rollouts(model: KnownMechanics, motions: int, steps: int, threads: int) -> Callable[[], Tensor]:
    """Return a call that rolls out motions under sampled inputs."""
    n = model.num_coordinates
    rng = torch.Generator().manual_seed(1)
    x0 = 0.1 * torch.randn(motions, 2 * n, generator=rng).double()
    t = STEP * torch.arange(steps + 1).double()
    u = 0.3 * torch.sin(2 * t[:, None] + torch.arange(n)).expand(motions, -1, -1)
    fast = model_for_rollouts(model, threads=threads)

    def call() -> Tensor:
        with torch.no_grad():
            return fast.predict(x0, t, Signal(t, u))

    return call


def environment(model: KnownMechanics, count: int, steps: int) -> Callable[[], None]:
    """Return a call that steps RobotEnv, or RobotVectorEnv with several robots."""
    data, plant = Motions(model.num_coordinates), ModelPlant(model, step=STEP)
    if count == 1:
        env = RobotEnv(plant, data=data, step=STEP, duration=1e3)
    else:
        env = RobotVectorEnv(plant, count, data=data, step=STEP, duration=1e3)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape)

    def call() -> None:
        for _ in range(steps):
            env.step(action)

    return call


def mujoco_calls(urdf: str, steps: int) -> dict[str, Callable[[], object]]:
    model = mujoco_model(MujocoArm(urdf, locked_joints=FINGERS))
    data = mujoco.MjData(model)
    data.qfrc_applied[:] = 0.3
    starts = np.zeros((MOTIONS, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))

    def many(threads: int) -> Callable[[], object]:
        copies = [mujoco.MjData(model) for _ in range(threads)]
        return lambda: mujoco.rollout.rollout(model, copies, starts, nstep=steps)

    return {
        "mj_step, 1 motion": lambda: mujoco.mj_step(model, data, 20 * steps),
        "mujoco.rollout, 1 thread": many(1),
        "mujoco.rollout, 2 threads": many(2),
    }


def law_seconds(model: KnownMechanics, folder: Path) -> float:
    """Return the time of an inverse dynamics of the exported C, compiled with -O2, in s."""
    function = [x for x in model_functions(model) if x.name == "inverse_dynamics"]
    write(function, folder / "arm.c", {})
    (folder / "main.c").write_text(_MAIN.format(n=model.num_coordinates, calls=_CALLS_OF_LAW))
    command = ["cc", "-O2", "main.c", "arm.c", "-o", "main", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    result = subprocess.run([folder / "main"], capture_output=True, text=True, check=True)
    return float(result.stdout.split()[0]) / _CALLS_OF_LAW


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="smoke run: few steps, no file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    compiled.BUILD_SECONDS = 0.0
    steps, rounds = (5, 1) if arguments.quick else (STEPS, arguments.rounds)
    chain = RigidChain(PANDA, locked_joints=FINGERS)
    model = double_copy(models_of(chain)["known"])
    calls = {
        "predict, 1 x 200": (rollouts(model, 1, 200, 1), 200),
        f"predict, {MOTIONS} x {steps}": (rollouts(model, MOTIONS, steps, 1), MOTIONS * steps),
        f"predict, {MOTIONS} x {steps}, 2 threads": (
            rollouts(model, MOTIONS, steps, 2),
            MOTIONS * steps,
        ),
        "RobotEnv.step": (environment(model, 1, 10 * steps), 10 * steps),
        "RobotVectorEnv.step, 256 robots": (environment(model, 256, steps), 256 * steps),
    }
    for name, call in mujoco_calls(PANDA, steps).items():
        calls[name] = call, steps * (20 if "1 motion" in name else MOTIONS)
    for call, _ in calls.values():
        call()  # builds loops
    rates: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, (call, count) in calls.items():
            rates[name].append(count / seconds(call))
    rows = [{"call": x, "steps_per_second": round(statistics.median(y))} for x, y in rates.items()]
    with tempfile.TemporaryDirectory() as folder:
        law = [law_seconds(model, Path(folder)) for _ in range(1 if arguments.quick else 3)]
    rows.append({"call": "inverse dynamics in C, -O2", "microseconds": round(1e6 * min(law), 2)})
    for row in rows:
        print(row, flush=True)
    if not arguments.quick:
        path = HERE / "results" / "usual_calls.csv"
        record = {key: provenance()[key] for key in ("hardware", "torch", "commit")}
        with path.open("w") as file:
            writer = csv.DictWriter(file, ["call", "steps_per_second", "microseconds", *record])
            writer.writeheader()
            writer.writerows({**row, **record} for row in rows)
        print(f"wrote {path}")


if __name__ == "__main__":
    main()
