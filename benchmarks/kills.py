"""Programs that are killed at a random moment and called again, beside ones that nobody killed.

Of each kill it is asked whether the same command then ends well and gives the same numbers, whether
a process lives on, and whether a file of the dead one is left.

    python -m benchmarks.kills                        # 50 kills, half of them with TMPDIR elsewhere
    python -m benchmarks.kills --kills 6 --only train fit

Each kill adds a row to benchmarks/results/kills.csv. The fit needs the double pendulum's log, in
the folder that PINN_DYN_LOGS names.
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import casadi
import numpy as np
import pandas as pd
import torch

from pinn_dyn.run.provenance import provenance
from tests.support.processes import alive

ROOT = Path(__file__).resolve().parents[1]
OTHER_DISK = Path("/dev/shm")  # a file system of its own
PATIENCE = 10.0  # s that a child may take to notice that its parent is gone

DATA = [
    *("dataset.duration=0.2", "dataset.step=0.002", "dataset.train_initial_states=2"),
    *("dataset.train_inputs=2", "dataset.validation=2", "dataset.test=2"),
]
TINY = [
    *DATA,
    *("data.stride=5", "data.pairs=64", "data.batch_size=32", "~callbacks.figures"),
    *("validator.horizon=0.1", "validator.window=null", "validator.step=null"),
]
LENGTH = ["trainer.steps=60", "trainer.validations=6"]
ARM = "model=lnn"
MANY = [  # a simulation that lasts some seconds
    *(word for word in TINY if not word.startswith(("dataset.step", "dataset.duration"))),
    *("dataset.step=0.002", "dataset.duration=2", "dataset.train_initial_states=15"),
    *("dataset.train_inputs=15", "trainer.steps=2", "trainer.validations=1"),
]
BLOCKS = [  # many steps of the optimizer between two checkpoints
    *("trainer.steps=600", "trainer.validations=3", "compile=false"),
]
LOG = [  # pieces of a log and a residual torque
    *("dataset=example_log", f"dataset.root={ROOT / 'examples'}"),
    *("model/residual=network", "data.pairs=64", "data.batch_size=32", "validator.horizon=0.5"),
    *("~callbacks.figures", "compile=false"),
]
FIT = [  # one step of the trainer that is a whole fit
    *(
        "experiment=known",
        "dataset=double_pendulum",
        "model.start=prior",
        f"model.structure.urdf={ROOT / 'examples/double_pendulum.urdf'}",
        "data.pairs=20",
        "data.batch_size=20",
    ),
    *("data.steps=2", "~callbacks.figures"),
]
ONCE = ["reference.q=[0.05,0.05,0.2]", "duration=0.02", "settled_after=0.01", "animate=false"]

Result = dict[str, np.ndarray]


class Program(NamedTuple):
    """A command in an empty folder, with ``run``, a training of before, beside it.

    Attributes:
        words: the script and its arguments.
        begun: what is there once it is at work.
        result: what it leaves behind, as arrays.
    """

    words: list[str]
    begun: str
    result: Callable[[Path], Result]


def weights(folder: Path) -> Result:
    """Of every training below a folder the last weights."""
    found = {}
    for path in sorted(folder.rglob("last.ckpt")):
        saved = torch.load(path, weights_only=True)
        found |= {f"{path.parts[-3]} {k}": v.numpy() for k, v in saved["state_dict"].items()}
        assert (path.parents[1] / "metrics.json").is_file()
    return found


def trajectories(folder: Path) -> Result:
    """The data set in the cache, of which there is one."""
    (path,) = (folder / "cache").glob("*.npz")
    with np.load(path) as archive:
        return {name: archive[name] for name in archive["names"]}


def table(name: str) -> Callable[[Path], Result]:
    """The numbers of a table, without the times that were measured."""

    def read(folder: Path) -> Result:
        frame = pd.read_csv(folder / "out" / name).select_dtypes("number")
        return {c: frame[c].to_numpy() for c in frame if "seconds" not in c}

    return read


def law(folder: Path) -> Result:
    """The inputs that an exported law gives."""
    function = casadi.Function.load(str(folder / "law.casadi"))
    state = [np.full(function.numel_in(k), 0.1) for k in range(function.n_in())]
    return {"u": np.array(function(*state)[0])}


PROGRAMS = {
    "train": Program(
        ["train.py", *TINY, *LENGTH, ARM, "hydra.run.dir=out"], "out/.hydra/config.yaml", weights
    ),
    "multirun": Program(
        ["train.py", "-m", *TINY, *LENGTH, ARM, "seed=0,1", "hydra.sweep.dir=out"],
        "out/0_lnn-seed0/.hydra/config.yaml",
        weights,
    ),
    "side by side": Program(
        [
            *("train.py", "-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", *TINY),
            *(*LENGTH, ARM, "seed=0,1", "hydra.sweep.dir=out"),
        ],
        "out/*/.hydra/config.yaml",
        weights,
    ),
    "blocks": Program(
        ["train.py", *TINY, *BLOCKS, ARM, "hydra.run.dir=out"], "out/checkpoints/last.ckpt", weights
    ),
    "start_from": Program(
        ["train.py", *TINY, *LENGTH, ARM, "start_from=run", "hydra.run.dir=out"],
        "out/.hydra/config.yaml",
        weights,
    ),
    "log": Program(
        ["train.py", *LOG, *LENGTH, ARM, "hydra.run.dir=out"], "out/.hydra/config.yaml", weights
    ),
    "fit": Program(["train.py", *FIT, "hydra.run.dir=out"], "out/.hydra/config.yaml", weights),
    "simulate": Program(
        ["train.py", *MANY, ARM, "hydra.run.dir=out"], "out/.hydra/config.yaml", trajectories
    ),
    "evaluate": Program(
        ["evaluate.py", "runs=[run]", "hydra.run.dir=out"],
        "out/.hydra/config.yaml",
        table("summary.csv"),
    ),
    "gather": Program(
        ["gather.py", "runs=[run]", "hydra.run.dir=out"],
        "out/.hydra/config.yaml",
        table("sweep.csv"),
    ),
    "export": Program(
        ["control.py", "run=run", *ONCE, "export=law.casadi", "hydra.run.dir=out"],
        "out/.hydra/config.yaml",
        law,
    ),
}
SHARES = [3, 2, 2, 4, 2, 2, 3, 2, 2, 2, 1]  # of the kills, in this order


def start(words: list[str], folder: Path, temporary: Path) -> subprocess.Popen[bytes]:
    """The program in a session of its own, where everything that it writes can be seen."""
    places = {"PINN_DYN_CACHE": str(folder / "cache"), "TMPDIR": str(temporary)}
    with (folder / "log.txt").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, str(ROOT / words[0]), *words[1:]],
            cwd=folder,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, **places, "OMP_NUM_THREADS": "1"},
            start_new_session=True,
        )


def prepared(folder: Path, run: Path | None) -> Path:
    """An empty folder, with a copy of the training and its data where there is one."""
    folder.mkdir()
    if run is not None:
        shutil.copytree(run / "out", folder / "run")
        shutil.copytree(run / "cache", folder / "cache")
    return folder


def differing(found: Result, expected: Result) -> str:
    """The first number that is another one; empty if there is none."""
    if found.keys() != expected.keys():
        return f"there is {', '.join(found)} instead of {', '.join(expected)}"
    for name, value in expected.items():
        if not np.array_equal(found[name], value, equal_nan=True):
            return f"{name} differs"
    return ""


def kill(program: Program, folder: Path, temporary: Path, after: float, expected: Result) -> str:
    """Kill the program so many seconds after it has begun; what is wrong, or nothing."""
    process = start(program.words, folder, temporary)
    while not list(folder.glob(program.begun)) and process.poll() is None:
        time.sleep(0.01)
    time.sleep(after)
    process.kill()
    killed = process.wait() == -signal.SIGKILL
    until = time.perf_counter() + PATIENCE
    while (orphans := alive(process.pid)) and time.perf_counter() < until:
        time.sleep(0.2)
    for pid in orphans:
        os.kill(pid, signal.SIGKILL)
    again = start(program.words, folder, temporary)
    status = again.wait()
    left = [str(path.relative_to(folder)) for path in folder.rglob("*.partial*")]
    left += [str(path.relative_to(folder)) for path in folder.rglob("*.damaged")]
    wrong = [f"{len(orphans)} processes lived on"] if orphans else []
    wrong += [f"left behind: {', '.join(left)}"] if left else []
    if status:
        return "; ".join([*wrong, f"called again it ended with {status}"])
    if problem := differing(program.result(folder), expected):
        wrong.append(problem)
    return "; ".join(wrong) or ("" if killed else "it had ended")


def write(row: dict[str, object]) -> None:
    """Add a row to the table in benchmarks/results."""
    path = Path(__file__).parent / "results" / "kills.csv"
    full = {**row, **provenance()}
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(full), lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerow(full)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--only", nargs="+", choices=list(PROGRAMS), help="not all programs")
    parser.add_argument("--seed", type=int, default=0, help="of the programs and the moments")
    arguments = parser.parse_args()
    draw = random.Random(arguments.seed)
    shares = zip(PROGRAMS, SHARES, strict=True)
    every = arguments.only or [name for name, n in shares for _ in range(n)]
    chosen = [every[k % len(every)] for k in range(arguments.kills)]
    draw.shuffle(chosen)

    place = Path(tempfile.mkdtemp(prefix="kills-"))
    near, far = place / "tmp", Path(tempfile.mkdtemp(prefix="kills-", dir=OTHER_DISK))
    near.mkdir()
    run = prepared(place / "before", None)
    assert start([*PROGRAMS["train"].words], run, near).wait() == 0, run / "log.txt"
    seconds: dict[str, float] = {}
    expected: dict[str, Result] = {}
    for name in dict.fromkeys(chosen):
        program, folder = PROGRAMS[name], prepared(place / f"whole {name}", run)
        if name == "simulate":
            shutil.rmtree(folder / "cache")
        process = start(program.words, folder, near)
        while not list(folder.glob(program.begun)) and process.poll() is None:
            time.sleep(0.01)
        begun = time.perf_counter()
        assert process.wait() == 0, folder / "log.txt"
        seconds[name] = time.perf_counter() - begun
        expected[name] = program.result(folder)
        print(f"{name}: {seconds[name]:.1f} s", flush=True)

    rows = []
    for number, name in enumerate(chosen):
        folder = prepared(place / f"{number} {name}", run)
        if name == "simulate":
            shutil.rmtree(folder / "cache")
        temporary, after = (near, far)[number % 2], draw.uniform(0, seconds[name])
        wrong = kill(PROGRAMS[name], folder, temporary, after, expected[name])
        row = {"program": name, "killed_after_s": round(after, 2), "wrong": wrong}
        rows.append({**row, "tmpdir": "elsewhere" if temporary == far else "beside"})
        print(rows[-1], flush=True)
        if not wrong:
            shutil.rmtree(folder)
        write(rows[-1])  # as it goes: an hour is long
    shutil.rmtree(far)
    survived = sum(row["wrong"] in ("", "it had ended") for row in rows)
    print(f"{survived} of {len(rows)} kills left nothing wrong; the others are in {place}")


if __name__ == "__main__":
    main()
