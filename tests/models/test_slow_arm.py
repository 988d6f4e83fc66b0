"""A slow soft arm with held commands: a prediction must keep what is measured at its start."""

import numpy as np
import pandas as pd
import pytest

import pinn_dyn
from pinn_dyn.data.logs import LogSource
from pinn_dyn.evaluation.baselines import HoldPosition
from pinn_dyn.evaluation.prediction import predict_trajectories

STEP, FINE, SECONDS = 0.25, 0.025, 900  # s


def slow_arm(seed=0):
    """Two pressures with a lag of 0.5 s, hysteresis, creep over 30 s and a drift, at 4 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(SECONDS / FINE)) * FINE
    ends = np.arange(0, SECONDS + 20, 20.0)
    targets = rng.uniform(-1, 1, (len(ends), 2))
    u = np.stack([np.interp(t, ends, x) for x in targets.T], axis=1)
    u = u[(np.arange(len(t)) // 40) * 40]  # one command per second
    p, s, creep, drift = np.zeros((4, 2))
    q = np.empty_like(u)
    for k, command in enumerate(u):
        p = p + FINE / 0.5 * (command - p)
        s = np.clip(s, p - 0.15, p + 0.15)
        f = np.tanh(s @ np.array([[1.2, 0.4], [-0.5, 0.9]]))
        creep = creep + FINE / 30 * (0.4 * f - creep)
        drift = drift + 0.005 * FINE**0.5 * rng.normal(size=2)
        q[k] = 40 * (0.6 * f + creep + drift)
    table = np.column_stack([t, q + 0.05 * rng.normal(size=q.shape), u])[:: round(STEP / FINE)]
    return pd.DataFrame(table, columns=["t", "x", "y", "p1", "p2"])


@pytest.mark.slow
def test_oscillators_on_a_slow_arm_are_ahead_of_its_last_position():
    columns = {
        "q": {"columns": ["x", "y"], "unit": "mm"},
        "u": {"columns": ["p1", "p2"], "unit": "bar"},
    }
    pieces = {"seconds": 150.0, "piece": 25.0}
    source = LogSource(
        files=slow_arm(),
        time={"columns": "t", "unit": "s"},
        validation=pieces,
        test=pieces,
        **columns,
    )
    run = pinn_dyn.train(source, "oscillators", steps=600)
    truth = pinn_dyn.mechanics.stack(source.load().test)
    step = run.model.fixed_step
    for window in (step, 4 * step):
        errors = [
            predict_trajectories(model, truth, window=window, step=step).error().mean()
            for model in (run.model, HoldPosition(2, 2))
        ]
        assert errors[0] < 0.9 * errors[1]
