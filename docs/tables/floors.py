"""The floors under every table, and the ground, which is the true equation.

    python -m docs.tables.floors                every test set, into results/floors.csv
    python -m docs.tables.floors soft_arm_1     some of them

The floors are those of evaluate.py; the linear ones are fitted to all of the training data. The
ground is the simulator's own equation of motion, rolled out by RK4 in the steps of the models
beside it: what integration alone costs. Beyond the training range it is computed alone, as the
evaluations there have their floors.

The logs of real robots are looked for in the folder PINN_DYN_LOGS.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pandas as pd

from pinn_dyn.app.build import build_source
from pinn_dyn.app.config import composed
from pinn_dyn.evaluation import (
    build_baselines,
    predict_trajectories,
    predict_windows,
    rollout_metrics,
)
from pinn_dyn.mechanics import Predictor, stack_until

FILE = Path(__file__).resolve().parents[2] / "results" / "floors.csv"
GROUND = "true equation"
# The least step of linear rivals, s: on the wide range ARX has 0.48 and EDMDc 0.18 in such, in the
# networks' steps of 2 ms 0.57 and 0.22.
_LINEAR_STEP = 0.01
# Of each data set: horizon, step of the roll-outs and windows, all in s.
SETS = {
    "soft_arm_1": (5.0, 0.002, (0.1, 1.0)),
    "soft_arm_1_wide": (5.0, 0.002, (0.1, 1.0)),
    "soft_arm_1_wide_beyond": (5.0, 0.002, ()),
    "soft_arm_2": (10.0, 0.005, (0.1, 1.0)),
    "soft_arm_2_beyond": (10.0, 0.01, ()),
    "panda": (2.0, 0.01, (0.05, 0.5)),
    "panda_beyond": (2.0, 0.01, ()),
    "double_pendulum": (2.0, 0.01, (0.1, 1.0)),
    "panda_gaz": (3.0, 0.02, (0.1, 1.0)),
    "soft_neck": (11.0, 0.1, (0.1, 1.0)),
    "trunk": (10.0, 0.1, (0.1, 1.0)),
}


def floors(name: str) -> list[dict[str, object]]:
    """Errors on the test trajectories of one data set, as evaluate.py counts them."""
    horizon, step, windows = SETS[name]
    source = build_source(composed("train", [f"dataset={name}", "model_name=floors"]))
    splits = source.load()
    truth = stack_until(splits.test, horizon)
    models: dict[str, tuple[Predictor, float]] = {}
    if not name.endswith("_beyond"):
        own = max(step, _LINEAR_STEP)
        built = build_baselines(splits.train, splits.validation, step=own)
        models |= {label: (floor, own) for label, floor in built.items()}
    if source.system is not None:
        models[GROUND] = source.system, step
    rows = []
    for label, (model, step) in models.items():
        whole = predict_trajectories(model, truth, step=step)
        figures = rollout_metrics(whole.q_hat, whole.q, whole.t, thresholds={})
        row = {"dataset": name, "model": label, "step": step, **figures.to_dict()}
        for window in windows:
            part = predict_windows(model, truth, window=window, step=step)
            found = rollout_metrics(part.q_hat, part.q, part.t, thresholds={})
            row[f"window_{window:g}s_error_mean"] = found.error_mean
            row[f"window_{window:g}s_diverged"] = found.diverged
        rows.append(row)
    return rows


if __name__ == "__main__":
    names = sys.argv[1:] or list(SETS)
    if unknown := set(names) - set(SETS):
        raise SystemExit(f"no data set {', '.join(unknown)}: expected some of {', '.join(SETS)}")
    shown = ["dataset", "model", "horizon", "error_mean", "error_median", "diverged"]
    for name in names:
        rows = pd.DataFrame(floors(name))
        print(rows[shown].to_string(index=False), flush=True)
        if FILE.exists():
            old = pd.read_csv(FILE)
            rows = pd.concat([old[old["dataset"] != name], rows])
        rows.sort_values(["dataset", "model"]).to_csv(FILE, index=False)
