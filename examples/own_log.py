"""Learn a robot from a log in a data frame and compare it with the constant-velocity baseline.

python examples/own_log.py [--steps 300]    writes the run folder runs/own_log
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

import pinn_dyn

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=1000, help="optimizer steps")
parser.add_argument("--folder", default="runs/own_log", help="run folder")
args = parser.parse_args()

log = pd.read_csv(Path(__file__).with_name("example_log.csv"))
model = pinn_dyn.fit(
    log,
    q={"columns": ["bend_x", "bend_y", "stretch"], "unit": ["deg", "deg", "mm"]},
    u={"columns": ["torque_x", "torque_y", "force"], "unit": ["Nm", "Nm", "N"]},
    run="run",
    steps=args.steps,
    folder=args.folder,
)
print(model)

columns = model.source.q.columns
for name, run in log[log.run.isin(model.source.test.names)].groupby("run"):
    predicted = model.predict(run)
    start = predicted.iloc[0].to_numpy()
    baseline = start[:3] + start[3:] * (run.t.to_numpy() - run.t.iloc[0])[:, None]
    errors = [
        np.abs(x - run[columns]).mean().round(1).to_dict() for x in (predicted[columns], baseline)
    ]
    print(f"{name}: mean error {errors[0]}, of constant velocity {errors[1]}")
