"""Track motions with random arms, with and without adaptation.

    python -m benchmarks.adaptive_arms [COUNT]

The robot has other bodies than the model, a payload at its tip and three times the friction. Its
inputs act 15 ms late, which the law knows, and are limited to what the motion needs. Measurements
have noise. The table has the RMS errors over 8 s, and is in benchmarks/results/adaptive_arms.csv.
"""

from __future__ import annotations

import copy
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from pinn_dyn.control import Actuator, AdaptiveTracking, Pipeline, Sines, SystemPlant, close_loop
from pinn_dyn.control.effects import Sensor
from pinn_dyn.systems import RigidChain
from tests.support.random_chains import random_chain

RESULTS = Path(__file__).parent / "results" / "adaptive_arms.csv"
PERIOD, DEAD_TIME, DURATION = 0.005, 0.015, 8.0  # s
BODIES, PAYLOAD, FRICTION = 0.3, 0.5, 3.0  # spread of log J; share of the tip's mass; factor
NOISE = 2e-4, 2e-3  # rad, rad/s
BANDWIDTH, RATIO = 5.0, 10.0  # position gain, and velocity gain over the typical inertia, 1/s


def loop(seed: int) -> dict[str, float]:
    """Return the row of an arm: its joints, RMS errors in rad, and their ratio."""
    generator = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.urdf"
        path.write_text(random_chain(generator))
        model = RigidChain(str(path), damping=0.1)
    robot, n = copy.deepcopy(model), model.num_coordinates
    with torch.no_grad():
        factors = np.exp(BODIES * generator.normal(size=len(robot.inertia)))
        robot.inertia *= torch.from_numpy(factors)[:, None, None]
        point = torch.from_numpy(np.append(generator.uniform(-0.2, 0.2, 3), 1.0))
        robot.inertia[-1] += PAYLOAD * robot.inertia[-1][3, 3] * point[:, None] * point
        robot.damping *= FRICTION
    draw = [generator.uniform(low, high, n) for low, high in ((-1, 1), (0.3, 0.6), (0.3, 1.0))]
    reference = Sines(*(x.tolist() for x in draw), rise_time=0.5)
    motions = [reference(t) for t in np.arange(0.0, DURATION, 0.05)]
    q, v, a = (torch.stack(x) for x in zip(*motions, strict=True))
    with torch.no_grad():
        limit = robot.inverse_dynamics(q, v, a).abs().amax(0)
        inertia = model.mass_matrix(q).diagonal(dim1=-2, dim2=-1).mean(0)
    errors = {}
    for name, rate in (("fixed", 1e-9), ("adaptive", 1.0)):
        law = AdaptiveTracking(model, BANDWIDTH, (RATIO * inertia).tolist(), rate=rate)
        actuator = Actuator((-limit).tolist(), limit.tolist())
        record = close_loop(
            SystemPlant(robot),
            Pipeline(law, PERIOD, actuator=actuator, dead_time=DEAD_TIME),
            reference,
            *(x[:1] for x in (q, v)),
            duration=DURATION,
            rate=1 / PERIOD,
            sensor=Sensor(*NOISE, seed=seed),
            dead_time=DEAD_TIME,
        )
        goal = torch.stack([reference(t).q for t in record.t.tolist()])
        error = (record.q[0] - goal).square().mean().sqrt()
        errors[name] = np.inf if record.stopped[0] else float(error)
    return {"seed": seed, "joints": n, **errors, "ratio": errors["adaptive"] / errors["fixed"]}


def main(count: int) -> None:
    """Write the rows of the table and print them."""
    torch.set_num_threads(1)
    rows = []
    for seed in range(count):
        rows.append(loop(seed))
        print(*(f"{x} {y:.4g}" for x, y in rows[-1].items()), sep=", ", flush=True)
    table = pd.DataFrame(rows)
    table.to_csv(RESULTS, index=False, float_format="%.4g")
    print(table["ratio"].describe().to_string())


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 30)
