"""Time the recording of the Panda data set with one process and with two.

    python benchmarks/panda_data.py

The data set is conf/dataset/panda.yaml, recorded in full, without the cache; the time includes the
start of the processes. Beside it stands the time of Bullet's own steps for as many samples under a
constant torque, which no way to record them can undercut in one process.
"""

from __future__ import annotations

import argparse
import time

import torch
from hydra import compose, initialize_config_dir

from pinn_dyn.app.build import build_source
from pinn_dyn.app.config import CONF, plain
from pinn_dyn.app.provenance import provenance
from pinn_dyn.data import RobotSource


def build(workers: int, train: int) -> RobotSource:
    """The data set as `python train.py dataset=panda` would build it."""
    overrides = [
        "dataset=panda",
        "model_name=none",
        f"dataset.workers={workers}",
        f"dataset.train={train}",
    ]
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        source = build_source(plain(compose("train", overrides=overrides)))
    assert isinstance(source, RobotSource)
    return source


def bare_steps(source: RobotSource, steps: int = 20_000) -> float:
    """Seconds of one step of Bullet with its torques set and its state read."""
    middle = (source.robot.q_low + source.robot.q_high) / 2
    zero = 0 * middle
    start = time.perf_counter()
    source.robot.set_state(middle, zero)
    for _ in range(steps):
        source.robot.step(zero, source.step)
    return (time.perf_counter() - start) / steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--train", type=int, default=70, help="number of training trajectories")
    train = parser.parse_args().train
    torch.set_num_threads(1)
    seconds = {}
    for workers in (1, 2):
        source = build(workers, train)
        start = time.perf_counter()
        arrays = source.simulate()
        seconds[workers] = time.perf_counter() - start
    count = sum(arrays[f"{split}_q"].shape[0] for split in ("train", "validation", "test"))
    samples = count * (len(arrays["t"]) - 1)
    print(f"{count} trajectories of {source.duration:g} s at {source.step:g} s: {samples} steps")
    print(f"hardware: {provenance()['hardware']}")
    print(f"{'Bullet alone, one process':30s} {bare_steps(source) * samples:8.1f} s")
    for workers, value in seconds.items():
        print(f"{f'data set, {workers} worker(s)':30s} {value:8.1f} s")


if __name__ == "__main__":
    main()
