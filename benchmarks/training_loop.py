"""Time of a whole training step, data in memory to updated weights, beside JAX with optax.

Ours is what train.py does: Trainer.fit with the learner, data module, callbacks, checkpoints and
TensorBoard log that the app builds of a configuration, compiled. JAX is a loop around a step that
is jitted as one: it picks the batch by index, takes loss and gradient, clips by the global norm and
moves the weights by AdamW (optax); or a scan of such steps, also jitted, whichever is faster. Both
start from the same network, see the same batches, take the same schedule, and are first checked to
end with the same weights. SOAP, which optax lacks, is timed alone.

    python benchmarks/training_loop.py                              # all cells that the file lacks
    python benchmarks/training_loop.py --sizes 3 --batches 256      # some of them
    python benchmarks/training_loop.py --device gpu --output gpu.csv   # on a GPU
    python benchmarks/training_loop.py --quick                      # a smoke run, no file
    python benchmarks/training_loop.py --quick --optimizers soap    # without jax and optax

A cell is written as soon as it is measured, and one that is there is not measured again: a run that
was stopped goes on. One core and one thread. After each epoch of ours, JAX takes as many steps, and
so does our loss and gradient alone: what an epoch takes beyond them is the loop and the optimizer.
Shares and ratios are of the processor time of the process, which others on the machine hardly
disturb; wall time stands beside it. On a GPU they are of wall time, until the card has done all.
"""

from __future__ import annotations

import argparse
import csv
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from itertools import islice, product
from pathlib import Path
from typing import Any

import configured
import lightning as L
import torch
from torch import Tensor

from pinn_dyn.app.config import composed
from pinn_dyn.data import DataSource, LightningData, Splits
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.mechanics.compilation import STEPS_FOR_PROGRAM
from pinn_dyn.run.configuration import build
from pinn_dyn.run.provenance import provenance
from pinn_dyn.run.training import trainer

RESULTS = Path(__file__).parent / "results"
STEP = 2e-3
PAIRS = 16_384
EPOCH = trainer.LONGEST_EPOCH
"""Steps between two checkpoints of train.py."""
CHECKED = 20
"""Steps after which the weights of both sides are compared."""
CELL = ("coordinates", "batch", "loss", "optimizer")
"""What a row is of."""

Row = dict[str, Any]
Turn = dict[str, tuple[float, float]]
"""Processor and wall time of each way in a round, s."""
Loop = Callable[[Iterator[Tensor]], Any]
"""Takes a step at each batch of positions, and gives the weights."""


class Sines(DataSource):
    """Sums of sines in every coordinate and input; no robot moves so, which costs the same."""

    name = "sines"

    def __init__(self, size: int):
        self.size = size
        self.labels = [f"q{k + 1}" for k in range(size)]
        self.input_labels = [f"u{k + 1}" for k in range(size)]

    def load(self) -> Splits:
        """Six motions of 10 s."""
        generator = torch.Generator().manual_seed(0)
        t = torch.arange(0, 10, STEP, dtype=torch.float64)

        def motion() -> Trajectory:
            rate, phase = 6 * torch.rand(2, 5, 1, self.size, generator=generator).double()
            angle = rate * t[:, None] + phase
            q, v, u = torch.sin(angle).sum(0), (rate * torch.cos(angle)).sum(0), angle.cos().sum(0)
            return Trajectory(q, v, Signal(t, u))

        motions = [motion() for _ in range(6)]
        return Splits(motions[:4], motions[4:5], motions[5:])


def configuration(
    size: int, batch: int, loss: str, optimizer: str, device: str, compiled: bool
) -> dict[str, Any]:
    """That of a long training, of which the first epochs are run, up to no validation."""
    words = [
        f"trainer.accelerator={device}",
        "model=lnn",
        "model_name=lnn",
        f"loss={loss}",
        f"optimizer={optimizer}",
        "data.stride=1",
        f"data.pairs={PAIRS}",
        f"data.batch_size={batch}",
        f"trainer.steps={STEPS_FOR_PROGRAM}",
        "trainer.validations=1",
        f"compile={str(compiled).lower()}",
        "~callbacks.figures",
    ]
    config = composed("train", words)
    config["dataset"] = {"name": "sines", "size": size}
    return config


def clocks() -> tuple[float, float]:
    """Of the processor and on the wall, s, when a GPU has done what it was given."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.process_time(), time.perf_counter()


def since(start: tuple[float, float]) -> tuple[float, float]:
    now = clocks()
    return now[0] - start[0], now[1] - start[1]


class Turns(L.Callback):
    """Clocks every epoch, and gives others their turn between two of them.

    Args:
        others: what takes as many steps as an epoch has, by name.
        rounds: epochs until the end, after a first one that compiles.
    """

    def __init__(self, others: dict[str, Callable[[], Any]], rounds: int):
        self.others = others
        self.rounds = rounds
        self.times: list[Turn] = []
        self._start: tuple[float, float] | None = None

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if self._start is None:
            self._start = clocks()

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        # What follows of an epoch, such as its checkpoint, counts to the next one.
        assert self._start is not None
        turn = {"ours": since(self._start)}
        for name, run in self.others.items():
            start = clocks()
            run()
            turn[name] = since(start)
        self.times.append(turn)
        trainer.should_stop = len(self.times) > self.rounds
        self._start = clocks()


def run_cell(
    size: int,
    batch: int,
    loss: str,
    optimizer: str,
    *,
    rounds: int,
    device: str = "cpu",
    steps: int | None = None,
    compiled: bool = True,
) -> Row:
    """The row of a cell: ``rounds`` epochs of ``steps`` steps."""
    torch._dynamo.reset()
    if steps is None:  # of an epoch, which ends with a checkpoint; fewer will do of large batches
        steps = EPOCH if batch <= 1024 else 40
    trainer.LONGEST_EPOCH = steps
    config = configuration(size, batch, loss, optimizer, device, compiled)
    L.seed_everything(0, verbose=False)
    data = configured.build_data(config, Sines(size))
    model = build.model_builder(config)(statistics=data.statistics)
    validator = configured.build_validator(config, data.statistics.step)
    learner = configured.build_learner(config, model, data.statistics, validator)
    windows = data.windows.to(torch.device("cpu"), torch.float32)
    first = windows[next(batches(data))]
    if device == "gpu":
        first = first.to(torch.device("cuda"))
    clock = 0 if device == "cpu" else 1
    others: dict[str, Callable[[], Any]] = {
        "loss and gradient": lambda: [learner._gradients(first) for _ in range(steps)]
    }
    chosen = ""
    if optimizer == "adamw":
        import jax_loops

        scale = learner.loss.scale.numpy().reshape(-1)
        rates = schedule(config, learner)
        loops = jax_loops.JaxLoops([model], windows, loss, scale, STEP, rates)
        chosen, fastest = rival(loops, config, data, clock)
        others["jax"] = lambda: fastest(islice(batches(data), steps))
    turns = Turns(others, rounds)
    fit(config, data, learner, validator, turns)
    times = turns.times[1:]

    def milliseconds(name: str, clock: int) -> float:
        return round(1e3 * statistics.median(turn[name][clock] for turn in times) / steps, 3)

    row: Row = dict(zip(CELL, (size, batch, loss, optimizer), strict=True))
    row |= {"ms": milliseconds("ours", 0), "wall_ms": milliseconds("ours", 1)}
    row["loss_and_gradient_ms"] = milliseconds("loss and gradient", clock)
    shares = [1 - turn["loss and gradient"][clock] / turn["ours"][clock] for turn in times]
    row["loop_and_optimizer"] = round(statistics.median(shares), 3)
    row |= dict.fromkeys(("jax_ms", "jax_wall_ms", "jax_slower", "smallest", "largest"), "")
    if chosen:
        ratios = [turn["jax"][clock] / turn["ours"][clock] for turn in times]
        row |= {"jax_ms": milliseconds("jax", 0), "jax_wall_ms": milliseconds("jax", 1)}
        row["jax_slower"] = round(statistics.median(ratios), 3)
        row |= {"smallest": round(min(ratios), 3), "largest": round(max(ratios), 3)}
    row |= {"jax_loop": chosen, "rounds": len(times), "steps_in_a_round": steps}
    return {**row, "first_epoch_s": round(turns.times[0]["ours"][1], 1)}


def rival(loops: Any, config: dict[str, Any], data: Any, clock: int) -> tuple[str, Loop]:
    """The fastest loop of JAX, and its name: of two spellings, step by step or as a scan."""

    def first() -> Iterator[Tensor]:
        return islice(batches(data), CHECKED)

    def checked(make: Callable[[str], Loop], spelling: str) -> tuple[float, str, Loop]:
        run, name = make(spelling), f"{spelling}, {make.__name__}"
        check_weights(config, data, name, run(first()))
        took = []
        for _ in range(5):
            start = clocks()
            run(first())
            took.append(since(start)[clock])
        print(f"{name}: {1e3 * min(took) / CHECKED:.3f} ms", flush=True)
        return min(took), name, run

    found = [checked(loops.one_by_one, spelling) for spelling in ("explicit", "autodiff")]
    spelling = min(found, key=lambda item: item[0])[1].split(",")[0]
    found.append(checked(loops.scan, spelling))
    return min(found, key=lambda item: item[0])[1:]


def batches(data: Any) -> Iterator[Tensor]:
    """Positions of an epoch's batches, ``(B,)``."""
    return iter(LightningData(data).sampler(0))


def fit(config: Any, data: Any, learner: Any, validator: Any, *callbacks: L.Callback) -> None:
    """Train as train.py does, in a folder that is thrown away."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        lightning = configured.build_trainer(config, place)
        lightning.callbacks = [*callbacks, *lightning.callbacks]  # type: ignore[attr-defined]
        lightning.fit(learner, LightningData(data))


def schedule(config: dict[str, Any], learner: Any) -> list[float]:
    """The learning rate of each step."""
    optimizer = learner._optimizer([torch.nn.Parameter(torch.zeros(1))])
    steps = config["trainer"]["steps"]
    scheduler = learner._scheduler(optimizer, total_steps=steps)
    rates = []
    for _ in range(steps):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    return rates


def check_weights(config: dict[str, Any], data: Any, name: str, tree: dict[str, Any]) -> None:
    """Compare the weights that JAX has after some steps with ours, uncompiled.

    Raises:
        RuntimeError: if they differ by more than 5 % of the way that they came: Adam divides by the
            size of a gradient, so that rounding counts where that is next to zero.
    """
    from training_step import named

    config = {**config, "compile": False}
    trainer.LONGEST_EPOCH, steps = CHECKED, trainer.LONGEST_EPOCH
    data = configured.build_data(config, data.source)
    L.seed_everything(0, verbose=False)
    model = build.model_builder(config)(statistics=data.statistics)
    start = {name: p.detach().clone() for name, p in model.named_parameters()}
    validator = configured.build_validator(config, data.statistics.step)
    learner = configured.build_learner(config, model, data.statistics, validator)
    fit(config, data, learner, validator, Turns({}, 0))
    trainer.LONGEST_EPOCH = steps
    ours, theirs = dict(model.cpu().named_parameters()), named(tree)
    way = sum(float((ours[key].detach() - start[key]).square().sum()) for key in start)
    apart = sum(float((ours[key].detach() - x).square().sum()) for key, x in theirs.items())
    share = (apart / way) ** 0.5
    if not share < 0.05:
        raise RuntimeError(f"{name}: the weights end {share:.2g} of their way apart")


def rows_of(path: Path) -> list[Row]:
    """What was measured before."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def append(row: Row, path: Path) -> None:
    """Write a row, below a header where it is the first."""
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)


def versions() -> dict[str, str]:
    """Those of the rivals, empty where they are not installed."""
    found = {}
    for name in ("jax", "optax"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = ""
    return found


def summary(rows: list[Row]) -> str:
    """The geometric mean over the cells that JAX has."""
    ratios = [float(row["jax_slower"]) for row in rows if row["jax_slower"]]
    if not ratios:
        return "no cell beside JAX"
    return (
        f"JAX and optax take {statistics.geometric_mean(ratios):.2f} times as long in the "
        f"geometric mean of {len(ratios)} cells, {min(ratios):.2f} in the closest"
    )


def main(words: list[str] | None = None) -> None:
    """Measure the cells that the command line names and the file lacks."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[3, 6, 7], help="N")
    parser.add_argument("--batches", type=int, nargs="+", default=[256, 1024, 8192])
    parser.add_argument("--losses", nargs="+", default=["increment", "midpoint"])
    parser.add_argument("--optimizers", nargs="+", default=["adamw", "soap"])
    parser.add_argument("--device", choices=["cpu", "gpu"], default="cpu")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--steps", type=int, help="steps in a round")
    parser.add_argument("--quick", action="store_true", help="smoke run: a small cell, no file")
    parser.add_argument("--output", type=Path, default=RESULTS / "training_loop.csv")
    arguments = parser.parse_args(words)
    if "adamw" in arguments.optimizers and "" in versions().values():
        parser.error(
            "adamw is timed beside jax and optax, which are not installed: "
            "pip install -e '.[bench]', or take --optimizers soap"
        )
    if arguments.device == "cpu":
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])
        os.environ["JAX_PLATFORMS"] = "cpu"
    torch.set_num_threads(1)
    if arguments.quick:
        for optimizer in arguments.optimizers:
            cell = (2, 32, "midpoint", optimizer)
            print(run_cell(*cell, rounds=1, steps=20, compiled=False))
        return
    rows = rows_of(arguments.output)
    there = {tuple(row[key] for key in CELL) for row in rows}
    record = {key: provenance()[key] for key in ("hardware", "torch", "commit")} | versions()
    if arguments.device == "gpu":
        record["hardware"] = torch.cuda.get_device_name()
    order = (arguments.optimizers, arguments.losses, arguments.sizes, arguments.batches)
    for optimizer, loss, size, batch in product(*order):
        cell = (size, batch, loss, optimizer)
        if tuple(map(str, cell)) in there:
            print(f"{', '.join(map(str, cell))}: is in {arguments.output}", flush=True)
            continue
        row = run_cell(
            *cell, rounds=arguments.rounds, steps=arguments.steps, device=arguments.device
        )
        row |= record
        append(row, arguments.output)
        print(row, flush=True)
    print(summary(rows_of(arguments.output)))


if __name__ == "__main__":
    main()
