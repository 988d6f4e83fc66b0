"""Time until a one-segment arm is predicted as well as in the paper: ours, and the paper's way.

Both learn from 8,000 pairs of the same simulated trajectories in memory. They stop once the mean
error of q over 5 s open loop on the validation trajectories is at most the error of the paper:
0.022 with a Hamiltonian network, 0.171 with a Lagrangian network. The clock includes compiling and
training, but not the rollouts that measure the error. One core.

    ours    experiment=soft_arm_1 model=hnn (or lnn) optimizer=soap trainer.steps=2000
            trainer.validations=2 compile=false, through the Lightning trainer
    paper   jax_paper.py: pairs of neighbouring samples, the paper's networks, loss and optimizer

    python benchmarks/time_to_error.py                    # at most 10 min for each of the four
    python benchmarks/time_to_error.py --minutes 1 --models lnn

A side that misses the goal within its time gives a lower bound of the ratio.
"""

from __future__ import annotations

import argparse
import csv
import os
import time
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from configured import build_data, build_learner, build_model, build_validator
from hydra import compose, initialize_config_dir

from pinn_dyn.app.config import CONF, resolved
from pinn_dyn.data import DynamicsData, LightningData
from pinn_dyn.evaluation import predict_trajectories
from pinn_dyn.mechanics import Predictor, Trajectory, stack
from pinn_dyn.run.provenance import provenance
from pinn_dyn.run.training.trainer import epochs

PAPER_ERROR = {"hnn": 0.022, "lnn": 0.171}
HORIZON = 5.0  # s
RESULTS = Path(__file__).parent / "results"


class Clock:
    """Seconds of training; stands still while the error is measured."""

    def __init__(self, every: float, limit: float):
        self.every, self.limit = every, limit
        self.start = time.perf_counter()
        self.next = 0.0
        self.history: list[tuple[float, float]] = []

    @property
    def now(self) -> float:
        return time.perf_counter() - self.start

    def finished(self, goal: float, error: Any) -> bool:
        """Whether to stop; measures the error when it is due, a quarter later each time."""
        seconds = self.now
        if seconds < self.next and seconds < self.limit:
            return False
        value = float(error())
        self.history.append((seconds, value))
        print(f"  {seconds:7.1f} s   error {value:.4f}", flush=True)
        self.next = seconds + max(self.every, 0.05 * seconds)
        self.start += self.now - seconds
        return value <= goal or seconds >= self.limit


class StopAtGoal(L.Callback):
    """Stops a training at the goal."""

    def __init__(self, clock: Clock, goal: float, truth: Trajectory, step: float):
        self.clock, self.goal, self.truth, self.step = clock, goal, truth, step

    def error(self, model: Predictor) -> float:
        prediction = predict_trajectories(model, self.truth, step=self.step)
        return float(prediction.error().nan_to_num(torch.inf).mean())

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: Any, *_: Any) -> None:
        trainer.should_stop = self.clock.finished(self.goal, lambda: self.error(pl_module.model))


def ours(config: dict[str, Any], data: DynamicsData, goal: float, clock: Clock) -> None:
    """Train as train.py does, until the goal."""
    L.seed_everything(config["seed"], verbose=False)
    statistics = data.statistics
    model = build_model(config, statistics)
    validator = build_validator(config, statistics.step)
    learner = build_learner(config, model, statistics, validator)
    truth = stack(data.splits.validation).until(HORIZON)
    trainer = L.Trainer(
        accelerator="cpu",
        devices=1,
        max_epochs=epochs(config["trainer"]["steps"], config["trainer"]["validations"])[0],
        limit_val_batches=0,
        inference_mode=False,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        callbacks=[StopAtGoal(clock, goal, truth, validator.step)],
    )
    trainer.fit(learner, LightningData(data))


def paper(data: DynamicsData, goal: float, clock: Clock, kind: str, options: Any) -> None:
    """Train the paper's network in JAX, until the goal or 6,000 epochs."""
    import jax.numpy as jnp
    import jax_paper

    f = {"hnn": jax_paper.hamiltonian, "lnn": jax_paper.lagrangian}[kind]
    state = "qp" if kind == "hnn" else "qv"
    windows = data.windows
    size, inputs = windows.q.shape[-1], windows.u.shape[-1]

    truth = stack(data.splits.validation).until(HORIZON)
    stride = round(options.roll_out_step / float(truth.t[1] - truth.t[0]))
    h = stride * float(truth.t[1] - truth.t[0])
    x = np.asarray(truth.states(state, slice(0, None, stride)), np.float32)
    u = np.asarray(truth.u[:, ::stride], np.float32).swapaxes(0, 1)
    roll_out = jax_paper.make_roll_out(f, h)

    def error() -> float:
        path = np.asarray(roll_out(parameters, x[:, 0], u)).swapaxes(0, 1)
        distance = np.linalg.norm((path - x)[..., :size], axis=-1)
        return float(np.where(np.isfinite(distance), distance, np.inf).mean())

    start = windows.start(state)
    after = start + windows.increments(state)[:, 0]
    pairs = [
        jnp.asarray(v.numpy(), jnp.float32)
        for v in (start, windows.u[:, 0], windows.u[:, -1], after)
    ]
    parameters = jax_paper.initial(size, inputs, seed=0)
    state = jax_paper.adam_state(parameters)
    update = jax_paper.make_update(f, float(windows.t[1]), size if kind == "lnn" else 0, options.lr)
    rng = np.random.default_rng(0)
    for _ in range(6000):
        order = rng.permutation(len(windows))
        for k in range(0, len(windows) - options.batch + 1, options.batch):
            parameters, state = update(parameters, state, pairs, order[k : k + options.batch])
            state[2].block_until_ready()  # JAX runs ahead: the clock would not see it
            if clock.finished(goal, error):
                return


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", nargs="+", default=["hnn", "lnn"], choices=["hnn", "lnn"])
    parser.add_argument("--minutes", type=float, default=10.0, help="at most, for each side")
    parser.add_argument("--every", type=float, default=1.0, help="seconds between measurements")
    parser.add_argument("--batch", type=int, default=256, help="of the paper's way")
    parser.add_argument("--lr", type=float, default=1e-3, help="of the paper's way")
    parser.add_argument("--roll-out-step", type=float, default=2e-3, help="of the paper's way, s")
    options = parser.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
    torch.set_num_threads(1)
    record = {key: provenance()[key] for key in ("hardware", "torch", "commit")}
    rows = []
    for kind in options.models:
        goal = PAPER_ERROR[kind]
        with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
            # The paper's error takes a short training: compiling would not pay.
            short = [
                "optimizer=soap",
                "trainer.steps=2000",
                "trainer.validations=2",
                "compile=false",
            ]
            words = ["experiment=soft_arm_1", f"model={kind}", f"model_name={kind}", *short]
            config = resolved(compose("train", overrides=words))
        found = {}
        for side in ("ours", "paper"):
            part = config["data"] if side == "ours" else {**config["data"], "stride": 1}
            data = build_data({**config, "data": part})
            data.windows  # noqa: B018  in memory before the clock starts
            print(f"{kind}, {side}: until the error over {HORIZON:g} s is {goal}", flush=True)
            clock = Clock(options.every, 60 * options.minutes)
            if side == "ours":
                ours(config, data, goal, clock)
            else:
                paper(data, goal, clock, kind, options)
            seconds, error = clock.history[-1]
            found[side] = seconds
            rows.append(
                {
                    "model": kind,
                    "side": side,
                    "goal": goal,
                    "reached": error <= goal,
                    "seconds": round(seconds, 1),
                    "error": error,
                    "best_error": min(e for _, e in clock.history),
                    **record,
                }
            )
        bound = "" if rows[-1]["reached"] else "at least "
        ratio = found["paper"] / found["ours"]
        print(f"{kind}: the paper's way takes {bound}{ratio:.1f} times as long")
    RESULTS.mkdir(exist_ok=True)
    with (RESULTS / "time_to_error.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [*rows[0]])
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
