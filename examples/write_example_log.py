"""Write example_log.csv, a simulated soft arm logged as a laboratory would: angles in degrees,
lengths in mm, noise, no velocities.

    python examples/write_example_log.py [file]
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from pinn_dyn.data import InitialStates, MultiSine
from pinn_dyn.data.simulation import simulate
from pinn_dyn.systems import SoftArm

RUNS, SECONDS, RATE, SEED = 12, 5, 50, 0
SETTLING = 1  # s of motion before the log starts


def main(path: Path) -> None:
    rng = np.random.default_rng(SEED)
    # Two bending torques in Nm, and an axial force in N that carries most of the weight. All vary
    # enough to tell A(q) u from G(q): with 0.05 N the model predicts, and its regulator diverges.
    inputs = MultiSine(
        offset=[0.0, 0.0, -1.15], amplitude=[1.2, 1.2, 0.3], frequency=[0.1, 2.0], harmonics=4
    )
    starts = InitialStates(q_low=[-0.5, -0.5, 0.3], q_high=[0.5, 0.5, 0.4], v_max=[0.0, 0.0, 0.0])
    signal = inputs.draw(RUNS, SETTLING + SECONDS, rng)
    t = np.arange(RATE * (SETTLING + SECONDS) + 1) / RATE
    q, _ = simulate(SoftArm(segments=1), *starts.draw(RUNS, rng), signal, t, rtol=1e-6, atol=1e-7)

    logged = slice(RATE * SETTLING, None)
    q, u, t = q[:, logged], signal(t)[:, logged], t[logged] - SETTLING
    shown = q * [180 / np.pi, 180 / np.pi, 1000.0] + rng.normal(size=q.shape) * [0.05, 0.05, 0.2]
    table = pd.DataFrame(
        {
            "run": np.repeat([f"run_{k:02}" for k in range(RUNS)], len(t)),
            "t": np.tile(t, RUNS).round(3),
            "bend_x": shown[..., 0].ravel().round(2),
            "bend_y": shown[..., 1].ravel().round(2),
            "stretch": shown[..., 2].ravel().round(2),
            "torque_x": u[..., 0].ravel().round(4),
            "torque_y": u[..., 1].ravel().round(4),
            "force": u[..., 2].ravel().round(4),
        }
    )
    table.to_csv(path, index=False)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("example_log.csv"))
