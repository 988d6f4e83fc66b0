"""Errors of the baselines, and of the true equation integrated by RK4, on the test trajectories.

    python -m benchmarks.baselines soft_arm_1 panda

Prints rows of results/results.csv. The linear baselines are fitted to all training data. The error
of the true equation is that of the integration alone, in the steps of the models beside it.
"""

from __future__ import annotations

import sys

import pandas as pd

from pinn_dyn.app.config import composed
from pinn_dyn.evaluation import (
    build_baselines,
    predict_trajectories,
    rollout_metrics,
)
from pinn_dyn.mechanics import Predictor, stack_until
from pinn_dyn.run.configuration.build import build_source

LINEAR_STEP = 0.01  # smallest step of the linear baselines, s; smaller steps give larger errors
# Horizon, step of the rollouts and windows of each data set, s.
SETS = {
    "soft_arm_1": (5.0, 0.002, (0.1, 1.0)),
    "soft_arm_1_wide": (5.0, 0.002, (0.1, 1.0)),
    "soft_arm_2": (10.0, 0.005, (0.1, 1.0)),
    "panda": (2.0, 0.01, (0.05, 0.5)),
    "double_pendulum": (2.0, 0.01, (0.1, 1.0)),
    "panda_gaz": (3.0, 0.02, (0.1, 1.0)),
    "soft_neck": (11.0, 0.1, (0.1, 1.0)),
    "trunk": (10.0, 0.1, (0.1, 1.0)),
}


def errors(name: str) -> pd.DataFrame:
    """Return the errors on the test trajectories of a data set, as evaluate.py computes them."""
    horizon, step, windows = SETS[name]
    source = build_source(composed("train", [f"dataset={name}", "model_name=baselines"]))
    splits = source.load()
    truth = stack_until(splits.test, horizon)
    linear_step = max(step, LINEAR_STEP)
    linear = build_baselines(splits.train, splits.validation, step=linear_step)
    models: dict[str, tuple[Predictor, float]] = {k: (x, linear_step) for k, x in linear.items()}
    if source.system is not None:
        models["true equation"] = source.system, step
    rows = []
    for label, (model, model_step) in models.items():
        parts = {"": predict_trajectories(model, truth, step=model_step)}
        for window in windows:
            parts[f"window_{window:g}s_"] = predict_trajectories(
                model, truth, window=window, step=model_step
            )
        for prefix, part in parts.items():
            metrics = rollout_metrics(part.q_hat, part.q, part.t, thresholds={}).to_dict()
            rows += [(name, label, f"{prefix}{key}", value) for key, value in metrics.items()]
    return pd.DataFrame(rows, columns=["robot", "model", "metric", "value"])


if __name__ == "__main__":
    for dataset in sys.argv[1:] or SETS:
        print(errors(dataset).to_csv(index=False), flush=True)
