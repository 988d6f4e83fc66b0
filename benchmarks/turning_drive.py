"""Networks and ARX on a simulated drive that turns several times.

    python -m benchmarks.turning_drive

The drive has dry friction, and an unbalanced load or none. Its torque is held for 1/67 s, and the
angle comes from an encoder of 4,096 counts. There are 30 logs of 11 s, seed 0.
"""

from functools import partial

import numpy as np
import pandas as pd
import torch

import pinn_dyn
from pinn_dyn.data.logs import LogSource
from pinn_dyn.evaluation import build_baselines
from pinn_dyn.evaluation.prediction import predict_trajectories
from pinn_dyn.mechanics import Predictor, stack
from pinn_dyn.models import CoulombFriction, LagrangianNetwork

RATE, SECONDS, RUNS, SUBSTEPS = 67, 11, 30, 40
INERTIA, DAMPING, FRICTION, LOAD = 0.02, 0.02, 0.15, 0.6  # kg m^2, Nms/rad, Nm, Nm
COUNT = 2 * np.pi / 4096  # rad


def simulated(load: float) -> pd.DataFrame:
    """Return the logs of a drive with a load in Nm."""
    rng = np.random.default_rng(0)
    step, samples = 1 / RATE, RATE * SECONDS
    short, t = step / SUBSTEPS, np.arange(samples) * step
    tables = []
    for run in range(RUNS):
        frequency, size = rng.uniform(0.1, 3, 6), rng.uniform(0.1, 0.4, 6)
        phase, factor = rng.uniform(0, 6.28, 6), rng.uniform(0.5, 1)
        sines = size * np.sin(2 * np.pi * frequency * t[:, None] + phase)
        torque = sines.sum(axis=1) * factor
        levels = np.repeat(rng.uniform(-0.5, 0.5, samples // 34 + 1), 34)[:samples]
        torque = torque + levels * (run % 2)
        q, v, angles = 0.0, 0.0, []
        for u in torque:
            angles.append(q)
            for _ in range(SUBSTEPS):
                free = v + short / INERTIA * (u - DAMPING * v - load * np.sin(q))
                v = np.sign(free) * max(abs(free) - short / INERTIA * FRICTION, 0.0)
                q += short * v
        encoder = np.round(np.array(angles) / COUNT) * COUNT
        tables.append(pd.DataFrame({"run": run, "t": t, "q": encoder, "u": torque}))
    return pd.concat(tables)


def log_of(frame: pd.DataFrame, interpolation: str) -> LogSource:
    """Return the data set of the logs, with four runs each for validation and test."""
    part = {"runs": 4, "piece": 5.0}
    return LogSource(
        files=frame,
        trajectory="run",
        time={"columns": "t", "unit": "s"},
        q={"columns": ["q"], "unit": "rad"},
        u={"columns": ["u"], "unit": "Nm"},
        interpolation=interpolation,
        validation=part,
        test=part,
    )


def report(name: str, model: Predictor, source: LogSource) -> None:
    """Print the mean error of windows of 1 s of the test runs."""
    truth = stack(source.load().test)
    with torch.no_grad():
        error = predict_trajectories(model, truth, window=1.0, step=1 / RATE).error()
    print(f"{name}: {float(error.mean()):.2g} rad in windows of 1 s", flush=True)


def main() -> None:
    """Train the networks, and print their errors and that of ARX."""
    cases = [("linear", []), ("linear", [0]), ("hold", [0])]
    for load, settings in ((LOAD, cases), (0.0, cases[:1])):
        frame = simulated(load)
        print(f"load {load:g} Nm, {np.ptp(frame.q) / (2 * np.pi):.2g} revolutions", flush=True)
        for interpolation, angles in settings:
            source = log_of(frame, interpolation)
            model = partial(LagrangianNetwork, friction=CoulombFriction, angles=angles)
            run = pinn_dyn.train(source, model, steps=1500, validations=5)
            report(f"lnn, interpolation {interpolation}, angles {angles}", run.model, source)
        source = log_of(frame, "linear")
        splits = source.load()
        arx = build_baselines(splits.train, splits.validation, step=1 / RATE)["ARX"]
        report("ARX", arx, source)


if __name__ == "__main__":
    main()
