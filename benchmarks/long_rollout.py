"""Long rollouts: the loop in C, the loop in Python, and MuJoCo on the same robot, in one run.

    python benchmarks/long_rollout.py                              # the Panda of the package
    python benchmarks/long_rollout.py --urdf $PINN_DYN_LOGS/ur10e/ur10e.urdf --locked
    python benchmarks/long_rollout.py --quick                      # a smoke run

Steps of RK4 per second of processor time on one core, float64, under sampled torques. `known` has
the bodies of the URDF and Coulomb friction, `lnn` has the joints of the robot and heads of 2 x 64
units. Neither is trained, since the weights do not change the time. The loop in Python runs for a
part of the steps, and the states of both are compared there. A short call has 200 steps. MuJoCo
runs `mj_step` with its RK4, without contacts, limits and friction, under constant torques.
"""

from __future__ import annotations

import argparse
import csv
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pinn_dyn.evaluation.prediction import model_for_rollouts
from pinn_dyn.exports import compiled
from pinn_dyn.mechanics import ContinuousPredictor, Signal, double_copy
from pinn_dyn.models import (
    CoulombFriction,
    KnownMechanics,
    LagrangianNetwork,
    NetworkCholesky,
    NetworkInput,
    NetworkPotential,
    Positive,
    Statistics,
)
from pinn_dyn.run.provenance import provenance
from pinn_dyn.systems import MujocoArm, RigidChain

HERE = Path(__file__).parent
PANDA = "franka_panda/panda.urdf"
FINGERS = ["panda_finger_joint1", "panda_finger_joint2"]
STEP = 1e-3
SHORT, CALLS = 200, 10  # steps of a short call, and calls that are timed


def models_of(chain: RigidChain) -> dict[str, ContinuousPredictor]:
    """Return known mechanics and a Lagrangian network with the joints of a robot."""
    one, scales = torch.ones(chain.num_coordinates), torch.ones(1, 2 * chain.num_coordinates)
    statistics = Statistics(0 * one, one, -one, one, one, one, 0 * one, one, scales, scales, STEP)
    torch.manual_seed(0)
    hidden = [64, 64]
    network = LagrangianNetwork(
        statistics,
        partial(NetworkCholesky, hidden=hidden),
        potential=partial(NetworkPotential, hidden=hidden),
        damping=partial(NetworkCholesky, hidden=hidden, positivity=Positive(floor=0.0)),
        input=partial(NetworkInput, hidden=hidden),
    )
    known = KnownMechanics(statistics, chain, start="prior", friction=CoulombFriction)
    return {"known": double_copy(known), "lnn": double_copy(network)}


def timed(work: Callable[[], Tensor]) -> tuple[float, Tensor]:
    """Return processor time in s, with that of compilers, and the result."""

    def clock() -> float:
        return time.process_time() + sum(os.times()[2:4])

    start = clock()
    result = work()
    return clock() - start, result


def forget() -> None:
    """Forget all code, as the next process has none."""
    compiled._CODES.clear()
    compiled._SECONDS.clear()


def measure(model: ContinuousPredictor, trajectories: int, steps: int, timed_steps: int) -> dict:
    """Return steps per second of both loops, and the processor time to build the loop.

    Raises:
        RuntimeError: if the states of both differ by more than 1e-9.
    """
    n = model.num_coordinates
    x0 = 0.1 * torch.randn(trajectories, 2 * n, generator=torch.Generator().manual_seed(1)).double()
    t = STEP * torch.arange(steps + 1).double()
    u = 0.3 * torch.sin(2 * t[:, None] + torch.arange(n)).expand(trajectories, -1, -1)

    @torch.no_grad()
    def roll_out(predictor: ContinuousPredictor, count: int) -> Tensor:
        times = t[: count + 1]
        return predictor.predict(x0, times, Signal(times, u[:, : count + 1]))

    fast = model_for_rollouts(model)
    build, _ = timed(lambda: roll_out(fast, timed_steps))
    forget()
    fast = model_for_rollouts(model)
    cached, _ = timed(lambda: roll_out(fast, timed_steps))
    seconds, states = timed(lambda: roll_out(fast, steps))
    short, _ = timed(lambda: [roll_out(fast, min(steps, SHORT)) for _ in range(CALLS)][-1])
    eager, expected = timed(lambda: roll_out(model, timed_steps))
    difference = float((states[:, : timed_steps + 1] - expected).abs().max())
    if not difference <= 1e-9:
        raise RuntimeError(f"the states of both loops differ by {difference:.2g}")
    return {
        "steps_per_second": round(trajectories * steps / seconds),
        "short_steps_per_second": round(CALLS * trajectories * min(steps, SHORT) / short),
        "eager_steps_per_second": round(trajectories * timed_steps / eager),
        "build_s": round(build, 1),
        "cached_build_s": round(cached, 2),
        "largest_difference": f"{difference:.1e}",
    }


def mujoco_model(arm: MujocoArm) -> Any:
    """Return the model of MuJoCo with RK4, without contacts, limits and friction."""
    import mujoco

    spec = mujoco.MjSpec.from_string(arm.text)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    spec.option.timestep = STEP
    spec.compiler.balanceinertia = True
    return spec.compile()


def mujoco_steps_per_second(arm: MujocoArm, steps: int) -> int:
    """Return the steps of ``mj_step`` with RK4 per second."""
    import mujoco

    model = mujoco_model(arm)
    data = mujoco.MjData(model)
    data.qfrc_applied[:] = 0.3
    start = time.process_time()
    mujoco.mj_step(model, data, steps)
    return round(steps / (time.process_time() - start))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--urdf", default=PANDA)
    parser.add_argument("--locked", nargs="*", default=None, help="locked joints; Panda: fingers")
    parser.add_argument("--quick", action="store_true", help="smoke run: few steps, no file")
    parser.add_argument("--output", type=Path, default=HERE / "results" / "long_rollout.csv")
    arguments = parser.parse_args()
    locked = FINGERS if arguments.locked is None and arguments.urdf == PANDA else arguments.locked
    torch.set_num_threads(1)
    compiled.BUILD_SECONDS = 0.0
    chain = RigidChain(arguments.urdf, locked_joints=locked or [])
    cases = [(1, 600, 20)] if arguments.quick else [(1, 50_000, 200), (1000, 100, 5)]
    about = {"robot": Path(arguments.urdf).stem, "joints": chain.num_coordinates}
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["PINN_DYN_CACHE"] = folder
        for name, model in models_of(chain).items():
            for trajectories, steps, timed_steps in cases:
                forget()
                row = {**about, "model": name, "trajectories": trajectories, "steps": steps}
                rows.append({**row, **measure(model, trajectories, steps, timed_steps)})
                print(rows[-1], flush=True)
    arm, steps = MujocoArm(arguments.urdf, locked_joints=locked or []), cases[0][1]
    row = {**about, "model": "MuJoCo", "trajectories": 1, "steps": steps}
    rows.append({**row, "steps_per_second": mujoco_steps_per_second(arm, steps)})
    print(rows[-1], flush=True)
    if not arguments.quick:
        exists = arguments.output.exists()
        with arguments.output.open("a" if arguments.locked is not None and exists else "w") as file:
            record = {key: provenance()[key] for key in ("hardware", "torch", "commit")}
            writer = csv.DictWriter(file, [*rows[0], *record])
            if file.mode == "w":
                writer.writeheader()
            writer.writerows({**row, **record} for row in rows)
        print(f"wrote {arguments.output}")


if __name__ == "__main__":
    main()
