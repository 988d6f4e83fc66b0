"""Several models of one log: where they disagree, do not trust them.

python examples/ensemble_with_spread.py [--steps 300]
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

import pinn_dyn

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=1000, help="steps of the optimizer")
parser.add_argument("--seeds", type=int, default=4)
args = parser.parse_args()

log = pd.read_csv(Path(__file__).with_name("example_log.csv"))
q = {"columns": ["bend_x", "bend_y", "stretch"], "unit": ["deg", "deg", "mm"]}
u = {"columns": ["torque_x", "torque_y", "force"], "unit": ["Nm", "Nm", "N"]}
runs = [pinn_dyn.fit(log, q=q, u=u, run="run", steps=args.steps)]
source = runs[0].source  # the other seeds have the same runs of the log for training
for seed in range(1, args.seeds):
    runs.append(pinn_dyn.train(source, "lnn", steps=args.steps, seed=seed))
ensemble = pinn_dyn.ensemble(runs)
print(ensemble)

run = log[log.run == ensemble.source.test.names[0]]
mean = ensemble.predict(run)[q["columns"]]
each = np.stack([member.predict(run)[q["columns"]] for member in ensemble.members])
table = pd.DataFrame({"t": run.t, "error": np.linalg.norm(mean - run[q["columns"]], axis=1)})
table["spread"] = np.sqrt(((each - mean.to_numpy()) ** 2).sum(axis=(0, 2)) / (len(each) - 1))
print(table.iloc[:: max(len(table) // 10, 1)].round(2).to_string(index=False))
